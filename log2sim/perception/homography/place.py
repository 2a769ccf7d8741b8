"""Places of obstacles without LiDAR points: where an object of typical size is whose image fills a box."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M
from log2sim.geometry import Array, Camera, apply_homography, homography_jacobian, wrap_angle
from log2sim.perception.boxes import LIMIT_SIGMAS, UNIFORM_SIGMA
from log2sim.perception.homography.correspondences import undistorted_pixels
from log2sim.perception.homography.estimate import FOOT_SIGMA_M, FOOT_SIGMA_PX
from log2sim.perception.homography.fit import ground_covariances

# Beyond this range one pixel of a camera at car height is several meters.
MAX_RANGE_M = 60.0
# Yaws at which an obstacle is tried, up to half turns; they are 10 degrees apart.
YAWS_RAD = np.arange(18) * np.pi / 18
# Shares of length and width within which an obstacle touches the ground: between the axles (a car's wheelbase is 2.7 of 4.4 m, that of
# buses and trucks half their length) and outer sides of the wheels, tires in one line, and the feet of a person.
CONTACT = {"vehicle": (0.6, 1.0), "two_wheeler": (0.6, 0.1), "pedestrian": (0.3, 0.3), "other": (0.8, 0.8)}
# Edges of a box.
LEFT, TOP, RIGHT, BOTTOM = range(4)


def place_obstacle(
    ground_H_image: Array,
    camera: Camera,
    box_px: Array,
    category: str,
    base_T_cam: Array,
    homography_covariance: Array | None = None,
    edge_sigma_px: Array | None = None,
) -> tuple[Array, Array] | None:
    """Place an obstacle by the box (4,) around its image: a cuboid that the edges of the box touch.

    `ground_H_image`: (3, 3), of `homography_covariance` (9, 9), None for 0. `category`: its typical sizes are used.
    `base_T_cam`: (4, 4): pose of the camera in the frame of the ground positions, m. `edge_sigma_px`: (4,): standard deviations
    of the left, upper, right and lower edge of the box, infinite where it ends with the image; None for those of an obstacle in sight.

    Returns its center (2,), m, on the ground and the covariance (2, 2); None above the horizon, beyond `MAX_RANGE_M`, and where
    its foot or both of its sides are outside the image.

    From above, the left and the right edge of the box are rays, the lower edge is a line, and the height of the box tells the
    distance of the near side. For each yaw the center and the errors of length, width and edges are a linear least-squares
    problem; the yaws are weighed by their marginal likelihoods. That a roof close below a camera looks larger is left out.
    """
    corners = undistorted_pixels(camera, box_px[[[0, 3], [2, 3], [0, 1], [2, 1]]])
    uv = (corners[0] + corners[1]) / 2
    (left, right, foot), below = apply_homography(ground_H_image, np.array([corners[0], corners[1], uv]))
    origin = base_T_cam[:2, 3]
    range_m = float(np.hypot(*(foot - origin)))
    edge_px = np.full(4, FOOT_SIGMA_PX) if edge_sigma_px is None else edge_sigma_px
    visible = np.isfinite(edge_px)
    if not visible[BOTTOM] or not (visible[LEFT] or visible[RIGHT]) or not below.all() or range_m > MAX_RANGE_M:
        return None
    by_px = homography_jacobian(ground_H_image, uv[None])[0]
    typical = np.array(TYPICAL_SIZE_M[category])
    size_sigma = typical * np.log(np.divide(MAX_SIZE_M[category], MIN_SIZE_M[category])) / LIMIT_SIGMAS
    contact, whole = np.array(CONTACT[GROUP_OF[category]]), np.ones(2)
    # Each edge: outward normal, how far out it is from the camera, the variance of that, and the part of the obstacle that it touches.
    rows: list[tuple[Array, float, float, Array]] = []
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(camera.K).T @ base_T_cam[:3, :3].T
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    for edge, ground, turn, corner in ((LEFT, left, 1.0, 0), (RIGHT, right, -1.0, 1)):
        if not visible[edge]:
            continue
        # A camera that looks down sees uprights lean: any height may be that of the side.
        lean = float(wrap_angle(bearing[corner + 2] - bearing[corner]))
        along = np.arctan2(*(ground - origin)[::-1]) + lean / 2
        normal = turn * np.array([-np.sin(along), np.cos(along)])
        variance = (edge_px[edge] * float(normal @ by_px[:, 0])) ** 2 + (UNIFORM_SIGMA * range_m * lean) ** 2
        rows.append((normal, 0.0, variance, whole))
    ahead = (foot - origin) / range_m
    normal = np.array([left[1] - right[1], right[0] - left[0]])
    normal = normal / np.hypot(*normal)
    normal = -normal if normal @ ahead > 0 else normal
    variance = (edge_px[BOTTOM] * float(normal @ by_px[:, 1])) ** 2
    if homography_covariance is not None:
        variance += float(normal @ ground_covariances(ground_H_image, homography_covariance, uv[None])[0] @ normal)
    rows.append((normal, float(normal @ (foot - origin)), variance, contact))
    spanned_m = spanned_height_m(ground_H_image, camera, box_px, base_T_cam)
    above_m = -range_m * float(rays[:2, 2].sum() / np.hypot(rays[:2, 0], rays[:2, 1]).sum())
    # Seen from above, the upper edge is that of the far side.
    if visible[TOP] and spanned_m > 0 and above_m < typical[2] + size_sigma[2]:
        of_edges = np.hypot(edge_px[TOP], edge_px[BOTTOM]) / (box_px[3] - box_px[1])
        relative = np.hypot(size_sigma[2] / typical[2], of_edges)
        by_height_m = range_m * typical[2] / spanned_m
        rows.append((-ahead, -by_height_m, (relative * by_height_m) ** 2, contact))
    normals, offsets, variances, parts = (np.array(column) for column in zip(*rows, strict=True))
    body = np.array([[np.cos(YAWS_RAD), np.sin(YAWS_RAD)], [-np.sin(YAWS_RAD), np.cos(YAWS_RAD)]])
    reach = np.abs(np.einsum("iky,nk->yni", body, normals)) / 2 * parts  # of an edge by length and width (Y, n, 2)
    noise = (reach * size_sigma[:2] ** 2) @ reach.swapaxes(1, 2) + np.diag(variances)
    weight = np.linalg.inv(noise)
    residual = offsets - reach @ typical[:2]
    information = normals.T @ weight @ normals
    covariance = np.linalg.inv(information)
    center = np.einsum("yij,jn,ynm,ym->yi", covariance, normals.T, weight, residual)
    off = residual - center @ normals.T
    squared = np.einsum("yn,ynm,ym->y", off, weight, off)
    log = -(squared + np.linalg.slogdet(noise)[1] + np.linalg.slogdet(information)[1]) / 2
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    mean = weights @ center
    offset = center - mean
    total = np.einsum("y,yij->ij", weights, covariance) + np.einsum("y,yi,yj->ij", weights, offset, offset)
    # Errors of edges that do not fit to each other are larger than they say (Birge, 1932).
    if len(rows) > 2:
        total *= max(1.0, float(squared.min()) / (len(rows) - 2))
    return origin + mean, total + FOOT_SIGMA_M**2 * np.eye(2)


def spanned_height_m(ground_H_image: Array, camera: Camera, box_px: Array, base_T_cam: Array) -> float:
    """Return the height that a box (4,) spans above its foot, m; NaN where it is seen straight from above.

    The pose of the camera (4, 4) is that in the frame of the ground positions.
    """
    middle = (box_px[0] + box_px[2]) / 2
    uv = undistorted_pixels(camera, np.array([[middle, box_px[1]], [middle, box_px[3]]]))
    rays = np.column_stack([uv, np.ones(2)]) @ np.linalg.inv(camera.K).T @ base_T_cam[:3, :3].T
    across = np.hypot(rays[:, 0], rays[:, 1])
    if not across.all():
        return float("nan")
    foot_xy = apply_homography(ground_H_image, uv[1:])[0][0]
    return float(-np.diff(rays[:, 2] / across)[0] * np.hypot(*(foot_xy - base_T_cam[:2, 3])))
