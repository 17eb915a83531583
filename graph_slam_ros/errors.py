"""The one family of errors that a user may see: each message names the culprit and fits on one line."""


class GraphSlamError(Exception):
    """Something was refused: a file, a parameter, a topic, a graph. The command line turns it into exit code 2."""


class NoiseError(GraphSlamError):
    """A covariance or information matrix that is not symmetric positive definite."""


class GaugeError(GraphSlamError):
    """Nothing fixes the position of a part of the graph."""


class SingularError(GraphSlamError):
    """The edges do not determine a vertex.

    Attributes
    ----------
    vertex : which; None where it has no number
    """

    def __init__(self, message: str, vertex: int | None = None) -> None:
        super().__init__(message)
        self.vertex = vertex


class DivergedError(GraphSlamError):
    """A solve whose result is not finite, or cannot be."""


class FormatError(GraphSlamError):
    """A file that cannot be read as what it claims to be."""


class ConfigError(GraphSlamError):
    """A configuration key, value or combination that is not valid."""


def message_of(error: BaseException) -> str:
    """An exception in one line: one of ours says enough by itself."""
    return str(error) if isinstance(error, GraphSlamError) else f"{type(error).__name__}: {error}"
