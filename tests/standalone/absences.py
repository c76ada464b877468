"""What of rclpy's API the standalone subset leaves out on purpose: the one list.

`docs/standalone.md` names all of it, and `test_rclpy_api.py` holds both to this.
"""

NAMES = {
    "rclpy.event_handler.PublisherEventCallbacks",
    "rclpy.event_handler.SubscriptionEventCallbacks",
    "rclpy.executors.ShutdownException",
    "rclpy.executors.TimeoutException",
    "rclpy.timer.Rate",
    "rclpy.wait_for_message.wait_for_message",
}
"""Classes and functions."""

MEMBERS = {
    "Context": {"handle"},
    "Client": {"configure_introspection", "handle"},
    "Clock": {"create_jump_callback", "handle", "sleep_for", "sleep_until"},
    "Duration": {"get_c_duration"},
    "Executor": {"can_execute", "create_task", "wait_for_ready_callbacks"},
    "GuardCondition": {"handle"},
    "AsyncParameterClient": {
        "delete_parameters",
        "load_parameter_file",
        "load_parameter_file_atomically",
        "on_parameter_event",
    },
    "Node": {
        "add_waitable",
        "count_clients",
        "count_services",
        "create_rate",
        "destroy_rate",
        "get_client_names_and_types_by_node",
        "get_node_names_and_namespaces_with_enclaves",
        "get_publisher_names_and_types_by_node",
        "get_service_names_and_types",
        "get_service_names_and_types_by_node",
        "get_subscriber_names_and_types_by_node",
        "handle",
        "remove_waitable",
        "set_descriptor",
        "wait_for_node",
        "waitables",
    },
    "Publisher": {"assert_liveliness", "handle", "wait_for_all_acked"},
    "QoSPresetProfiles": {"BEST_AVAILABLE"},
    "QoSProfile": {"get_c_qos_profile"},
    "ReliabilityPolicy": {"BEST_AVAILABLE"},
    "DurabilityPolicy": {"BEST_AVAILABLE"},
    "LivelinessPolicy": {"BEST_AVAILABLE"},
    "Service": {"configure_introspection", "handle"},
    "Subscription": {"handle"},
    "Timer": {"handle"},
}
"""Members by the class that has them; classes derived from it lack them too."""

PARAMETERS = {
    "create_node": {"enable_logger_service"},
    "Node.__init__": {"enable_logger_service"},
    "Node.create_publisher": {"event_callbacks", "publisher_class"},
    "Node.create_subscription": {"event_callbacks"},
}
"""Parameters of functions that are there."""

PROFILES = {"qos_profile_best_available"}
"""Presets of `rclpy.qos`."""

MADE_BY_NODES = {"Client", "Publisher", "Service", "Subscription"}
"""Classes whose constructors take something of the middleware, which is another one here."""
