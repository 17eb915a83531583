"""Parameters of landmarks: their noise, identity, association and loss."""

from dataclasses import dataclass

from graph_slam_ros.config.loss import LEAST_LOSS_SCALE, LOSSES
from graph_slam_ros.config.parameter import setting


@dataclass(frozen=True, slots=True)
class LandmarksConfig:
    """Landmark sightings."""

    id_from: str = setting("id", "field of a detection that is the landmark's identity", choices=("id", "class_id"))
    sigma_m: float = setting(
        0.1, "position noise of an observation whose message has an all-zero (unknown) covariance", "m", low=1e-4
    )
    added_sigma_m: float = setting(
        0.05,
        "position noise added to every observation for errors that messages leave out: clocks, mounting, size",
        "m",
        low=0.0,
    )
    association: str = setting(
        "id",
        "data association: none: landmarks are not used; id: by identity; joint: observations without identity by "
        "several hypotheses, which later ones decide",
        choices=("none", "id", "joint"),
    )
    unnamed_sigma_m: float = setting(
        0.14,
        "position noise added to observations without identity: where on an object, or on which of several, it is seen",
        "m",
        low=0.0,
    )
    density_per_m: float = setting(
        0.03,
        "prior density of landmarks per metre along each axis: an observation must fit a known "
        "landmark better than a new one",
        "1/m",
        low=1e-4,
    )
    surveyed: str = setting(
        "",
        "landmarks with known positions in the map: a header id,x,y,sigma or id,x,y,z,sigma, then a line for each;"
        " with columns for an orientation and other noise as in docs/inputs.md",
        "m, rad",
    )
    surveyed_file: str = setting("", "file with the lines of landmarks.surveyed, read at the start where that is empty")
    loss: str = setting(
        "huber_then_cauchy",
        "robust loss of landmark observations; huber_then_cauchy converges with Huber first, then with Cauchy",
        choices=LOSSES,
    )
    loss_scale: float = setting(
        3.0,
        "landmark residuals well below this many standard deviations keep their full weight",
        "sigma",
        low=LEAST_LOSS_SCALE,
    )
