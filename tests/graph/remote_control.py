"""A person elsewhere on the ROS domain, with parameters to set and reports to read."""

import functools
import subprocess
import sys
import time


class RemoteControl:
    """Sets parameters, of ``session_control`` or another node, and hears what nodes report."""

    def __init__(self):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.parameter_client import AsyncParameterClient
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from sensor_msgs.msg import Image

        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self.node = Node("remote_control", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._asking = functools.cache(lambda name: AsyncParameterClient(self.node, name))
        self.reports = {}
        self.states = []
        self.images = 0
        self.size = None
        self.scenes = {}
        self.node.create_subscription(DiagnosticArray, "diagnostics", self._take, 100)
        self.node.create_subscription(Image, "ultrasound/image", self._imaged, 10)
        kept = QoSProfile(depth=200, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(DiagnosticArray, "session/scenes", self._listed, kept)

    def set(self, of="session_control", /, **values):
        """Set them together; the reason where that is refused."""
        from rclpy.parameter import Parameter

        parameters = [Parameter(name, value=value) for name, value in values.items()]
        answer = self._answer(of, lambda client: client.set_parameters_atomically(parameters))
        return answer.result.reason

    def value(self, name, of="session_control"):
        """A parameter's value now."""
        from rcl_interfaces.msg import Parameter as ParameterMessage
        from rclpy.parameter import Parameter

        answer = self._answer(of, lambda client: client.get_parameters([name]))
        return Parameter.from_parameter_msg(
            ParameterMessage(name=name, value=answer.values[0])
        ).value

    def _answer(self, of, ask):
        """Ask until there is an answer: a service of a killed node is seen for 20 s more."""
        client = self._asking(of)
        self.until(client.services_are_ready)
        asked, again = ask(client), time.monotonic() + 5

        def has_come():
            nonlocal asked, again
            if time.monotonic() > again:
                asked, again = ask(client), time.monotonic() + 5
            return asked.done()

        self.until(has_come)
        return asked.result()

    def until(self, condition, seconds=100):
        """Listen until that is so."""
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, (self.states[-5:], self.reports)
            self._executor.spin_once(timeout_sec=0.05)

    def report(self, node="session_control"):
        """The last report of a node, by key."""
        return self.reports.get(node, {})

    @property
    def state(self):
        return self.report().get("state", "")

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _take(self, message):
        for status in message.status:
            name = status.name.rsplit("/", 1)[-1]
            self.reports[name] = {item.key: item.value for item in status.values}
            self.reports[name]["message"] = status.message
            if name == "session_control":
                self.states.append(status.message)

    def _imaged(self, message):
        self.images += 1
        self.size = message.width, message.height

    def _listed(self, message):
        self.scenes = {status.name: status for status in message.status}


def started(*words, cwd):
    """`us-sim WORDS` in a process of its own."""
    command = [sys.executable, "-m", "us_sim", *map(str, words)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=cwd)
