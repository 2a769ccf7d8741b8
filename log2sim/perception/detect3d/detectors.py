"""3D boxes of road users in clouds: from a network through ONNX Runtime, or from the 3D labels of the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from log2sim import registry
from log2sim.config_sections import LidarConfig
from log2sim.datatypes import Boxes3D, Log
from log2sim.errors import ConfigError, Log2SimError, PluginError
from log2sim.perception.lidar.cloud import Cloud
from log2sim.plugin_checks import DETECT_IN_CLOUD, require_members

PREFIX = "lidar:"
MEMBERS = ("name", "detect")


class LidarDetector(Protocol):
    """Detector of road users in one cloud."""

    @property
    def name(self) -> str:
        """Name in the provenance of a scenario."""
        ...

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Detect road users in one cloud, best score first; deterministic, and may be called from threads.

        Parameters
        ----------
        cloud
            All LiDARs of one moment.
        earlier
            Clouds of earlier moments, which make the grid denser; only points of `cloud` count as points of a box.
        """
        ...


def create_lidar_detector(name: str, log: Log, settings: LidarConfig) -> LidarDetector:
    """Make a detector for the clouds of a log.

    Parameters
    ----------
    name
        "lidar:" and a registered name ("vehicle", "roadside", "labels", plug-ins of others) or the path of an `.onnx` file.
    log
        The log whose clouds it will see; `labels` takes its boxes from there.
    settings
        Decoding, range and lowest score.

    Raises
    ------
    ConfigError
        An unknown name, or a file that is no usable network.
    MissingExtra
        The detector's package is not installed.
    """
    if not name.startswith(PREFIX):
        raise ConfigError(
            f"LiDAR detector '{name}': expected a name that begins with '{PREFIX}', such as lidar:vehicle"
        )
    rest = name.removeprefix(PREFIX)
    if rest.lower().endswith(".onnx"):
        from log2sim.perception.detect3d.network_detector import open_network

        return open_network(Path(rest), settings, name=f"{PREFIX}{Path(rest).name}")
    try:
        create = registry.load("lidar_detector", rest)
    except PluginError:
        raise
    except ConfigError as error:
        raise ConfigError(f"{error}, or {PREFIX} and the path of an ONNX file (ending in .onnx)") from None
    with registry.blaming("lidar_detector", rest):
        detector: LidarDetector = create(log, settings)
    if registry.is_built_in("lidar_detector", rest):
        return detector
    return checked(detector, registry.say_plugin("lidar_detector", rest))


def checked(detector: Any, source: str) -> LidarDetector:
    """Return a detector of somebody else whose faults are told in one line each that begins with `source`.

    Raises
    ------
    PluginError
        When it lacks a member of `LidarDetector`, or its `detect` cannot be called.
    """
    require_members(detector, MEMBERS, DETECT_IN_CLOUD, source)
    return _CheckedLidarDetector(detector, source)


@dataclass(frozen=True, eq=False)
class _CheckedLidarDetector:
    inner: LidarDetector
    source: str

    @property
    def name(self) -> str:
        return self.inner.name

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        try:
            found = self.inner.detect(cloud, earlier)
        except (Log2SimError, MemoryError):
            raise
        except Exception as error:
            raise PluginError(f"{self.source}: cloud at {cloud.stamp_ns}: {registry.say_exception(error)}") from error
        if not isinstance(found, Boxes3D):
            raise PluginError(f"{self.source}: detect returned {type(found).__name__}, expected Boxes3D")
        return found
