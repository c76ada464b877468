"""What rclpy's compiled part defines: errors, and things that can be destroyed."""


class RCLError(RuntimeError):
    """An operation on a node, an endpoint or a context failed."""


class RCLInvalidROSArgsError(RCLError):
    """An argument after --ros-args is malformed."""


class UnknownROSArgsError(RuntimeError):
    """An argument after --ros-args is none that ROS knows."""


class InvalidHandle(RuntimeError):
    """Something that was destroyed is used."""


class Destroyable:
    """Something that exists until `destroy`."""

    _destroyed = False

    def destroy(self) -> None:
        """End its existence; a second time does nothing."""
        self._destroyed = True

    def _require_existence(self) -> None:
        if self._destroyed:
            raise InvalidHandle("cannot use Destroyable because destruction was requested")
