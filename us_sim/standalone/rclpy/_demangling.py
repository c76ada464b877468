"""ROS names of DDS topics and types, as rmw_dds_common translates them.

>>> topic_name("rt/us/image"), type_name("sensor_msgs::msg::dds_::Image_")
('/us/image', 'sensor_msgs/msg/Image')
>>> service_name("rq/probe/get_parametersRequest")
'/probe/get_parameters'
"""

__all__ = ["service_name", "service_type_name", "topic_name", "type_name"]

_SERVICE_TOPICS = (("rq/", "Request"), ("rr/", "Reply"))


def topic_name(dds_topic: str) -> str | None:
    """The ROS topic behind a DDS topic, None when there is none."""
    return dds_topic[2:] if dds_topic.startswith("rt/") else None


def service_name(dds_topic: str, prefix: str | None = None) -> str | None:
    """The ROS service behind a DDS topic, None when there is none.

    Args:
        dds_topic: the name.
        prefix: `rq/` for requests only, `rr/` for responses only.
    """
    for start, end in _SERVICE_TOPICS:
        if dds_topic.startswith(start) and dds_topic.endswith(end) and prefix in (None, start):
            return dds_topic[2 : -len(end)]
    return None


def type_name(dds_type: str) -> str:
    """The ROS type behind a DDS type; the name itself when it is none of ROS."""
    package, separator, rest = dds_type.partition("::dds_::")
    if not separator or not rest.endswith("_"):
        return dds_type
    return f"{package.replace('::', '/')}/{rest[:-1]}"


def service_type_name(dds_type: str) -> str:
    """The ROS service type behind the DDS type of its requests or responses."""
    return type_name(dds_type).removesuffix("_Request").removesuffix("_Response")
