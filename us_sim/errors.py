"""Errors that reach a person: each is one sentence with the fault, its place, and a remedy."""


def printable_line(text: str, longest: int = 2000) -> str:
    """Return the text on one line without control characters; a long one loses its middle."""
    half = longest // 2
    cut = text if len(text) <= longest else f"{text[:half]} … {text[len(text) - half :]}"
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in cut)


class UsSimError(Exception):
    """Base of every error that this package raises for bad input."""

    key: str = ""  # of the setting that is wrong, below its section; empty where it is none
    problem: str = ""  # the fault of that key

    def __str__(self) -> str:
        """Return the sentence in one printable line."""
        return printable_line(super().__str__())


class SettingsError(UsSimError):
    """A setting is unknown, or has a value that will not do."""


class SceneError(UsSimError):
    """A scene file, or a value in it, cannot be used."""


class MessageError(UsSimError):
    """A message that came in cannot be read, or is not for where it was sent."""


class FrameError(MessageError):
    """A message is in another coordinate frame than it must be."""


class StampError(UsSimError):
    """A stamp is no time."""


class PoseError(UsSimError):
    """A pose is not a rigid transform: not finite, or without an orientation."""


class MeshError(UsSimError):
    """A mesh, or a material of its elements, cannot carry a deformation."""


class SolverError(UsSimError):
    """A solver refuses its settings, its model or a state to take over."""


class VolumeError(UsSimError):
    """A volume cannot be read or sampled."""


class CaseError(UsSimError):
    """A case cannot be read, or cannot be made or changed where it was asked to."""


class ProbeError(UsSimError):
    """A probe's geometry cannot form an image or a collider."""


class BagError(UsSimError):
    """A bag cannot be read, or cannot be written where it was asked to."""


class TrackingError(UsSimError):
    """A tracker's data, or the file of its bodies, cannot be used."""


class CalibrationError(UsSimError):
    """Measurements are wrong, or cannot determine a calibration or a stiffness."""


class EpisodeError(UsSimError):
    """An action cannot be done, or an environment or a data set cannot be made as asked."""


class ScoreError(UsSimError):
    """A recording cannot be scored as it was asked."""
