"""Say that ranges alone leave many landmarks without a place: of those that have one, some are on the wrong side."""

from collections.abc import Mapping

_TWO, _MANY, _FEWEST = " places fit: ", 0.25, 4  # of the reasons; part and number of landmarks


def wrong_sides(landmarks: int, waiting: Mapping[str, str]) -> str:
    """Return that landmarks may be on the wrong side of the path; empty where few are undecided, or in the map.

    Parameters
    ----------
    landmarks : that are in the map
    waiting : landmarks that are not, with the reason
    """
    undecided = sum(_TWO in reason for reason in waiting.values())
    if landmarks < _FEWEST or undecided < max(_FEWEST, _MANY * (landmarks + len(waiting))):
        return ""
    return (
        f"ranges alone: of {undecided} of {landmarks + len(waiting)} landmarks two places fit, one on either side of "
        "the path, so they are not used; others may be in the map on the wrong side, and covariances do not contain "
        "that. Drive more turns in sight of them, or add bearings or surveyed landmarks (landmarks.surveyed)"
    )
