"""The fused top-down picture of one tick: the pictures of all cameras on the road that their homographies were fitted to."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import inverse
from log2sim.mapping.ground_view import GroundView
from log2sim.mapping.mosaic import BirdsEyeView, render_birdseye
from log2sim.perception.first_pass import base_pose
from log2sim.perception.frames import RecordReader
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.seam_stage import roads_at
from log2sim.perception.sync import Schedule

# A pixel of a camera on a car shows about half a meter of road along the line of sight at this distance.
REACH_M = 25.0
CELL_M = 0.05


def fuse_tick(
    log: Log,
    schedule: Schedule,
    homographies: Mapping[str, CameraHomography],
    tick: int,
    reader: RecordReader,
    *,
    reach_m: float = REACH_M,
    cell_m: float = CELL_M,
) -> BirdsEyeView:
    """Draw the pictures of a tick on the road around the cameras, with gains that balance their exposures.

    Cameras without a frame at the tick, without a homography, or with a picture that cannot be read are left out. The picture
    is in the ground frame: that of the ego at the stamp of the tick, or that of the map for cameras at the road.
    """
    map_T_base = base_pose(log, int(schedule.t_ns[tick]))
    views, places = [], []
    for name, road in roads_at(log, schedule, homographies, tick).items():
        index = int(schedule.frames[name][tick])
        image = reader.get(name, index)
        if image is not None:
            views.append(GroundView(image, road, log.cameras[name], signed=True))
            pose = log.map_T_sensor(name, int(log.streams[name].t_ns[index]))[0][0]
            places.append((inverse(map_T_base) @ pose)[:2, 3])
    x, y = np.mean(places, axis=0).tolist() if places else (0.0, 0.0)
    extent = (x - reach_m, x + reach_m, y - reach_m, y + reach_m)
    return render_birdseye(views, extent_m=extent, resolution_m=cell_m, frame="ego" if log.ego is not None else "map")
