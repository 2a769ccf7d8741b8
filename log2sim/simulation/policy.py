"""What a user's policy observes and returns, and how it is loaded by name.

Positions are box centers in the map frame in m, yaw is counter-clockwise from +x in rad within [-pi, pi), speed is
along the heading in m/s (negative in reverse), time is in s on the scenario's clock. All arrays are read-only.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Scenario, Sweep
from log2sim.errors import ConfigError, PluginError
from log2sim.files import plugins
from log2sim.files.plugins import nearest
from log2sim.geometry import Array

SIGHT_M = 100.0  # default range of observed agents
ROUTE_AHEAD_S = 10.0
ROUTE_STEP_S = 0.1
PATH_AHEAD_M = 100.0


@dataclass(frozen=True)
class Controls:
    """What a policy returns: the commands until its next call."""

    accel_mps2: float  # positive throttle, negative brake; braking ends at standstill
    steer_rad: float  # at the road wheels, positive left
    reverse: bool = False  # engages at standstill; throttle then drives backward


@dataclass(frozen=True)
class EgoState:
    """Pose, motion, actuators and size of the ego.

    A curvature c takes a steering angle of atan(wheelbase c (1 + understeer speed^2)).
    """

    x_m: float  # box center and heading, map frame; likewise `y_m`, `z_m`, `yaw_rad`
    y_m: float
    z_m: float
    yaw_rad: float
    speed_mps: float
    accel_mps2: float  # present state of the actuators: along the heading; at the road wheels; likewise `steer_rad`
    steer_rad: float
    length_m: float
    width_m: float
    height_m: float
    wheelbase_m: float  # from the rear to the front axle
    rear_axle_offset_m: float  # from the rear axle, about which a vehicle turns, forward to the box center
    understeer_s2pm2: float


@dataclass(frozen=True, eq=False)
class Others:
    """Other agents whose box center is within range, nearest first, as columns (A,); static ones too."""

    id: NDArray[Any]  # (A,); likewise `category`
    category: NDArray[Any]
    # (A,): an agent on another level, by `z_m` and `height_m`, is no obstacle; likewise `y_m`, `z_m`, `yaw_rad`,
    # `speed_mps`.
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    velocity_x_mps: Array  # (A,), m/s: on the axes of the map; likewise `velocity_y_mps`
    velocity_y_mps: Array
    length_m: Array  # (A,); likewise `width_m`, `height_m`
    width_m: Array
    height_m: Array

    def __len__(self) -> int:
        """Return the number of agents."""
        return len(self.x_m)


@dataclass(frozen=True, eq=False)
class Route:
    """States of the scenario's ego during the next 10 s, as columns (T,) every 0.1 s until the end of the scenario."""

    t_s: Array  # (T,); likewise `x_m`, `y_m`, `yaw_rad`, `speed_mps`
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array


@dataclass(frozen=True, eq=False)
class PathAhead:
    """The path of the scenario's ego ahead of the ego, whenever it was there, as columns (P,): 100 m, one row a meter.

    Beyond the end of the scenario the path goes straight on at the last speed.
    """

    progress_m: float  # distance along the path up to the first row, which is the one nearest to the ego
    distance_m: Array  # (P,): from the first row
    x_m: Array  # (P,); likewise `y_m`
    y_m: Array
    yaw_rad: Array  # (P,): direction of travel
    speed_mps: Array  # (P,): speed of the scenario at this place
    t_s: Array  # (P,): when the scenario was there; NaN beyond its end


@dataclass(frozen=True, eq=False)
class Observation:
    """What a policy observes at one time."""

    t_s: float
    dt_s: float  # the returned controls hold for this long
    ego: EgoState
    others: Others
    route: Route
    path: PathAhead
    # What `sweep` and `image` call; None where no sensors are simulated.
    look: Callable[[Observation, Literal["sweep", "image"], str], Any] | None = None

    def sweep(self, name: str) -> Sweep:
        """Return the sweep of a LiDAR that ends now, its points in the LiDAR's frame at their own times; it is cast when asked for.

        Raises `ConfigError` where no sensors are simulated (`log2sim.resim.simulate.with_sensors` does), or for a LiDAR
        that is not simulated.
        """
        sweep: Sweep = self._looked("sweep", name)
        return sweep

    def image(self, name: str) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3), BGR, that a camera takes now; it is made when asked for.

        Raises `ConfigError` as of `sweep`; and where the ego is too far off the recorded path.
        """
        image: NDArray[np.uint8] = self._looked("image", name)
        return image

    def _looked(self, kind: Literal["sweep", "image"], name: str) -> Any:
        if self.look is None:
            raise ConfigError(
                f"{kind} '{name}': no sensors are simulated; wrap the policy by log2sim.resim.simulate.with_sensors"
            )
        return self.look(self, kind, name)


# A function, or an object with `__call__` and, if it has a state of its own, `reset(scenario)`.
Policy = Callable[[Observation], Controls]


def reset_policy(policy: Policy, scenario: Scenario) -> None:
    """Call a policy's `reset(scenario)` if it has one, so that it can be used for several replays."""
    reset = getattr(policy, "reset", None)
    if reset is None:
        return
    try:
        reset(scenario)
    except PluginError:  # of a plug-in, which names its package
        raise
    except Exception as error:
        raise ConfigError(f"policy: reset raised {type(error).__name__}: {error}") from error


def query_policy(policy: Policy, observation: Observation) -> Controls:
    """Call a policy and check what it returns."""
    where = f"policy at {observation.t_s:g} s"
    try:
        answer = policy(observation)
    except PluginError:
        raise
    except Exception as error:
        # A user's policy may raise anything; the chained traceback shows its author where.
        raise ConfigError(f"{where}: raised {type(error).__name__}: {error}") from error
    if not isinstance(answer, Controls):
        raise ConfigError(
            f"{where}: answered {type(answer).__name__}, expected log2sim.simulation.policy.Controls(accel_mps2, steer_rad)"
        )
    try:
        finite = math.isfinite(answer.accel_mps2) and math.isfinite(answer.steer_rad)
    except TypeError:
        finite = False
    if not finite:
        raise ConfigError(f"{where}: answered {answer}, expected finite numbers")
    return answer


def load_policy(name: str) -> Policy:
    """Load the policy "module:attribute" or "path/to/file.py:attribute", or a plug-in by its name; the attribute may contain dots.

    A module is looked up in the current folder first, as `python -m` does; a file can import from its own folder. A class is
    instantiated without arguments.

    Raises `ConfigError` when the name has another form, or cannot be imported, instantiated or called.
    """
    source, colon, attribute = name.rpartition(":")
    if not colon and name:  # what another package declares as an entry point of the group "log2sim.policy"
        try:
            target: Any = plugins.load("policy", name)
        except PluginError:
            raise
        except ConfigError as error:
            raise ConfigError(
                f"{error}; of a module or a file, expected module:attribute or file.py:attribute, such as my_driver:brake_late"
            ) from None
        label = plugins.plugin_label("policy", name)
        return PluginPolicy(_made(target, label, PluginError), label)
    if not (source and attribute):
        raise ConfigError(
            f"policy '{name}': expected module:attribute or file.py:attribute, such as my_driver:brake_late, or the name of a plug-in"
        )
    try:
        path = Path(source)
        with _first_on_path(path.resolve().parent if source.endswith(".py") else Path.cwd()):
            if not source.endswith(".py"):
                target = importlib.import_module(source)
            else:
                spec = importlib.util.spec_from_file_location(f"log2sim_policy_{path.stem}", path)
                if spec is None or spec.loader is None:
                    raise ImportError(f"{path} is no Python file")
                target = importlib.util.module_from_spec(spec)
                sys.modules[spec.name] = target  # dataclasses of the file look their module up there
                spec.loader.exec_module(target)
    except Exception as error:  # a user's module may raise anything while it is imported
        raise ConfigError(f"policy '{name}': '{source}' cannot be imported: {type(error).__name__}: {error}") from error
    for part in attribute.split("."):
        if not hasattr(target, part):
            known = [key for key in vars(target) if not key.startswith("_")] if hasattr(target, "__dict__") else []
            raise ConfigError(f"policy '{name}': there is no '{part}' in '{source}'{nearest(part, known)}")
        target = getattr(target, part)
    return _made(target, f"policy '{name}'", ConfigError)


@dataclass(frozen=True, eq=False)
class PluginPolicy:
    """A policy of another package; its faults are told with the name of the package."""

    inner: Policy
    source: str  # how messages name it

    def reset(self, scenario: Scenario) -> None:
        """Prepare it for a replay, if it wants to be."""
        with self._blamed():
            reset_policy(self.inner, scenario)

    def __call__(self, observation: Observation) -> Controls:
        """Return its controls."""
        with self._blamed():
            return query_policy(self.inner, observation)

    @contextmanager
    def _blamed(self) -> Iterator[None]:
        try:
            yield
        except ConfigError as error:  # whatever it raises and returns is one already
            raise PluginError(f"{self.source}: {error}") from error


def _made(target: Any, source: str, error_type: type[ConfigError]) -> Policy:
    """Return the policy itself, which a class is made to without arguments."""
    if isinstance(target, type):
        try:
            target = target()
        except Exception as error:
            raise error_type(f"{source}: cannot be made: {type(error).__name__}: {error}") from error
    if not callable(target):
        raise error_type(f"{source}: is a {type(target).__name__}, expected a callable policy(observation) -> Controls")
    result: Policy = target
    return result


@contextmanager
def _first_on_path(folder: Path) -> Iterator[None]:
    """Search a folder before all others during an import."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        if str(folder) in sys.path:
            sys.path.remove(str(folder))
