"""Bird's-eye view of a whole log: the ground seen by its cameras at several ticks, in the map frame.

Cameras are mapped by their calibration and the ego's full pose. Homographies fitted to obstacles do not serve here: they
are fitted where obstacles were, in a frame that follows the vehicle's pitch, so seams between ticks and cameras grow.
"""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Log, Scenario
from log2sim.errors import LogError
from log2sim.geometry import NS_PER_S, nearest_index
from log2sim.mapping.ground_view import GroundView
from log2sim.mapping.mosaic import BirdsEyeView, Mosaic
from log2sim.perception.frames import RecordReader
from log2sim.perception.lidar.cloud import cloud_origin
from log2sim.perception.record_checks.thumbnails import shrink

# Ticks that are mapped, evenly over the scenario.
TICKS = 15
# Ground around the ego's path; farther away a pixel is longer than a cell.
MARGIN_M = 35.0
RESOLUTION_M = 0.06


def birdseye_of_log(log: Log, scenario: Scenario, reader: RecordReader | None = None) -> BirdsEyeView:
    """Map the ground around the ego's path, or around the sensors of a roadside log.

    The cameras are those that the scenario was made with, or all of the log where it names none, as truth does. `reader`
    counts the images that cannot be read.

    Raises
    ------
    LogError
        When the log has no camera, or no image of a camera can be read.
    """
    reader = reader or RecordReader(log)
    used = [str(c["name"]) for c in scenario.cameras if c.get("used") and c["name"] in log.cameras]
    used = used or list(log.cameras)
    if not used:
        raise LogError(f"{log.name}: the log has no camera, so there is no picture of the ground")
    stamps = scenario.t0_ns + np.round(np.linspace(0, scenario.duration_s, TICKS) * NS_PER_S).astype(np.int64)
    places = np.array([cloud_origin(log, int(t))[0][:2] for t in stamps])
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    mosaic = Mosaic(extent_m=extent, resolution_m=RESOLUTION_M)
    for t in stamps:
        ground_z = cloud_origin(log, int(t))[1]
        views = []
        for name in used:
            stream = log.streams[name]
            i = int(nearest_index(stream.t_ns, t)[0])
            map_T_cam, known = log.map_T_sensor(name, stream.t_ns[i])
            if not known[0]:
                continue
            image = reader.get(name, i)
            # What a black picture or a copy of an earlier one shows is not there.
            if image is not None and reader.watch.cameras[name].judge(int(stream.t_ns[i]), shrink(image)) == "live":
                views.append(GroundView.from_pose(image, log.cameras[name], map_T_cam[0], ground_z))
        mosaic.add(views)
    reader.require_some()
    return mosaic.image()
