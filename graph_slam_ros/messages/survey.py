"""The file of surveyed landmarks. It is read once at the start, and its rows become part of the configuration."""

from pathlib import Path

from graph_slam_ros.config.survey import surveyed
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.formats.strict import lines
from graph_slam_ros.slam import Config


def with_survey(config: Config) -> Config:
    """The configuration with the rows of ``landmarks.surveyed_file``, unless it has some, as a repeated run does.

    Raises
    ------
    GraphSlamError
        Naming the file, the line and what is wrong with it.
    """
    settings = config.landmarks
    if not settings.surveyed_file or settings.surveyed:
        return config
    file = Path(settings.surveyed_file).expanduser()
    text = "".join(line for _, line in lines(file)).removeprefix("\ufeff")  # which spreadsheets write
    try:
        if not surveyed(text, config.world.dimensions):
            raise ConfigError("no landmark in it")
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from None
    return config.changed({"landmarks.surveyed": text})
