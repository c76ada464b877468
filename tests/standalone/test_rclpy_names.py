"""Names of nodes, topics and services: what is allowed, what they expand to, how they are remapped.

The sentences and positions are those that rcl and rmw write.
"""

import pytest
import rclpy

if rclpy.__name__ == "rclpy":
    pytest.skip("the real rclpy has its own checks", allow_module_level=True)

from rclpy._names import (
    expand,
    require_namespace,
    require_node_name,
    require_topic_name,
)
from rclpy.exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidServiceNameException,
    InvalidTopicNameException,
)
from std_msgs.msg import String
from std_srvs.srv import Trigger


@pytest.mark.parametrize(
    ("name", "sentence", "index"),
    [
        ("", "topic name must not be empty string", 0),
        ("7image", "topic name token must not start with a number", 0),
        ("us/7image", "topic name token must not start with a number", 3),
        ("us/", "topic name must not end with a forward slash", 2),
        (
            "us image",
            "topic name must not contain characters other than alphanumerics, "
            "'_', '~', '{', or '}'",
            2,
        ),
        ("us/~", "topic name must not have tilde '~' unless it is the first character", 3),
        (
            "~image",
            "topic name must not have a tilde '~' that is not followed by a forward slash '/'",
            1,
        ),
        ("us/{node}", "topic name must not have a {substitution}, not known without ROS 2", 3),
    ],
)
def test_a_topic_name_that_is_not_allowed_says_where(name: str, sentence: str, index: int) -> None:
    with pytest.raises(InvalidTopicNameException) as caught:
        require_topic_name(name, is_service=False)
    assert str(caught.value) == (f"Invalid topic name: {sentence}:\n  '{name}'\n   {' ' * index}^")


@pytest.mark.parametrize("name", ["~", "~/image", "/us/image", "us", "_hidden"])
def test_ordinary_topic_names_are_allowed(name: str) -> None:
    require_topic_name(name, is_service=False)


@pytest.mark.parametrize(
    ("name", "sentence", "index"),
    [
        ("", "must not be empty", 0),
        ("us", "must be absolute, it must lead with a '/'", 0),
        ("/us/", "must not end with a '/'", 3),
        ("/us//image", "must not contain repeated '/'", 4),
        ("/us/7", "must not have a token that starts with a number", 4),
        ("/us image", "must not contain characters other than alphanumerics, '_', or '/'", 3),
    ],
)
def test_full_names_and_namespaces_have_the_same_rules(
    name: str, sentence: str, index: int
) -> None:
    pointer = f"\n   {' ' * index}^"
    with pytest.raises(InvalidTopicNameException, match="topic name " + sentence) as caught:
        require_topic_name(name, is_service=False, is_full=True)
    assert str(caught.value).endswith(pointer)
    with pytest.raises(InvalidServiceNameException, match="Invalid service name"):
        require_topic_name(name, is_service=True, is_full=True)
    with pytest.raises(InvalidNamespaceException, match="namespace " + sentence) as caught:
        require_namespace(name)
    assert str(caught.value).endswith(pointer)


def test_the_root_is_a_namespace_and_no_topic() -> None:
    require_namespace("/")
    with pytest.raises(InvalidTopicNameException, match="must not end with"):
        require_topic_name("/", is_service=False, is_full=True)
    with pytest.raises(InvalidTopicNameException, match="length should not exceed"):
        require_topic_name("/" + "a" * 247, is_service=False, is_full=True)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("", "node name must not be empty"),
        ("my-probe", "must not contain characters other than alphanumerics or '_'"),
        ("1probe", "node name must not start with a number"),
        ("a" * 256, "node name length should not exceed '255'"),
    ],
)
def test_node_names(name: str, sentence: str) -> None:
    with pytest.raises(InvalidNodeNameException, match=sentence):
        require_node_name(name)


def test_names_expand_for_their_node() -> None:
    def expanded(name: str) -> str:
        return expand(name, "probe", "/left")

    assert expanded("image") == "/left/image"
    assert expanded("~/image") == "/left/probe/image"
    assert expanded("~") == "/left/probe"
    assert expanded("/image") == "/image"
    assert expand("image", "probe", "/") == "/image"
    with pytest.raises(ValueError, match="topic name 'us image' is invalid"):
        expanded("us image")


def test_nodes_refuse_names_that_are_not_allowed(bench) -> None:
    with pytest.raises(InvalidNodeNameException):
        bench.node("my-probe")
    with pytest.raises(InvalidNamespaceException):
        bench.node("probe", namespace="le-ft")
    node = bench.node("probe", namespace="left")
    assert node.get_namespace() == "/left"
    assert node.get_fully_qualified_name() == "/left/probe"
    with pytest.raises(InvalidTopicNameException):
        node.create_publisher(String, "us image", 1)
    with pytest.raises(InvalidTopicNameException, match="repeated '/'"):
        node.create_subscription(String, "us//image", print, 1)
    with pytest.raises(InvalidServiceNameException):
        node.create_service(Trigger, "re set", print)
    with pytest.raises(InvalidServiceNameException):
        node.create_client(Trigger, "7reset")
    with pytest.raises(InvalidTopicNameException):
        node.count_publishers("us//image")


def test_rules_of_the_command_line_rename_nodes_topics_and_services(bench_with) -> None:
    bench = bench_with(
        "--ros-args -r __ns:=/right --remap __node:=needle -r image:=us/picture -r "
        "~/state:=/state -r other:image:=nowhere -r rostopic://reset:=reset_topic -r "
        "rosservice://reset:=restart -r image:=never_the_second"
    )
    node = bench.node("probe", namespace="left")
    assert node.get_fully_qualified_name() == "/right/needle"
    assert node.resolve_topic_name("image") == "/right/us/picture"
    assert node.resolve_topic_name("image", only_expand=True) == "/right/image"
    assert node.resolve_topic_name("/right/image") == "/right/us/picture"
    assert node.resolve_topic_name("/image") == "/image"
    assert node.resolve_topic_name("~/state") == "/state"
    assert node.resolve_topic_name("reset") == "/right/reset_topic"
    assert node.resolve_service_name("reset") == "/right/restart"
    assert node.get_logger().name == "right.needle"
    publisher = node.create_publisher(String, "image", 1)
    assert publisher.topic_name == "/right/us/picture"
    assert publisher.topic == "image"
    service = node.create_service(Trigger, "reset", lambda _, response: response)
    assert service.service_name == "/right/restart"
    assert service.srv_name == "reset"


def test_rules_for_one_node_leave_the_others_alone(bench_with) -> None:
    bench = bench_with("--ros-args -r probe:image:=picture -r skin:__ns:=/arm")
    assert bench.node("probe").resolve_topic_name("image") == "/picture"
    skin = bench.node("skin")
    assert skin.get_fully_qualified_name() == "/arm/skin"
    assert skin.resolve_topic_name("image") == "/arm/image"


def test_a_nodes_own_arguments_come_first_and_it_may_ignore_the_others(bench_with) -> None:
    bench = bench_with("--ros-args -r image:=picture -r pose:=place")
    own = bench.node("own", cli_args=["--ros-args", "-r", "image:=own_picture"])
    assert own.resolve_topic_name("image") == "/own_picture"
    assert own.resolve_topic_name("pose") == "/place"
    alone = bench.node("alone", use_global_arguments=False)
    assert alone.resolve_topic_name("image") == "/image"
