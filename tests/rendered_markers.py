"""Pictures of marker bodies at known poses: every pixel the mean of rays through it."""

import cv2
import numpy as np

from us_sim.pose import Pose
from us_sim.tracking.markers import dictionary


def render(
    camera,
    body,
    pose,
    *,
    blur=0.7,
    noise=2.0,
    black=30.0,
    white=210.0,
    samples=4,
    seed=0,
    image=None,
):
    """(rows, columns) grey: the body's markers on white margins, on a grey background."""
    picture = np.full((camera.height, camera.width), 120.0) if image is None else image
    depths = pose.apply(body.centres)[:, 2]
    normals = body.normals @ pose.rotation.T
    front = (normals * pose.apply(body.centres)).sum(axis=1) < 0
    for row in np.argsort(-depths):
        if front[row]:
            _draw(picture, camera, body, row, pose, black, white, samples)
    picture = cv2.GaussianBlur(picture, (0, 0), blur) if blur else picture
    random = np.random.default_rng(seed)
    picture = picture + random.normal(0.0, noise, picture.shape)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def _draw(picture, camera, body, row, pose, black, white, samples):
    corners = pose.apply(body.corners[row])
    bits = dictionary(body.dictionary).markerSize + 2
    code = cv2.aruco.generateImageMarker(dictionary(body.dictionary), int(body.ids[row]), bits) > 0
    # Affine coordinates (s, t) of the marker: 0 to 1 along its upper and its left edge.
    origin, along, down = corners[0], corners[1] - corners[0], corners[3] - corners[0]
    margin = 1.0 / bits
    outer = [
        origin + s * along + t * down for s in (-margin, 1 + margin) for t in (-margin, 1 + margin)
    ]
    pixels = camera.project(np.array(outer))
    if not np.isfinite(pixels).all():
        return
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, [camera.width, camera.height])
    if (high <= low).any():
        return
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    u = (np.arange(low[0], high[0])[:, None] + steps).ravel()
    v = (np.arange(low[1], high[1])[:, None] + steps).ravel()
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    rays = camera.rays(grid.reshape(-1, 2))
    rays = np.column_stack([rays, np.ones(len(rays))])
    # origin + s along + t down = depth × ray
    inverse = np.linalg.inv(np.column_stack([along, down, origin]))
    s, t, k = inverse @ rays.T
    s, t = s / k, t / k
    inside = (s >= -margin) & (s < 1 + margin) & (t >= -margin) & (t < 1 + margin)
    column = np.clip((s * bits).astype(int), 0, bits - 1)
    line = np.clip((t * bits).astype(int), 0, bits - 1)
    square = (s >= 0) & (s < 1) & (t >= 0) & (t < 1)
    value = np.where(square & ~code[line, column], black, white)
    shape = (high[1] - low[1], samples, high[0] - low[0], samples)
    cover = inside.reshape(shape).mean(axis=(1, 3))
    mean = np.where(inside, value, 0.0).reshape(shape).mean(axis=(1, 3))
    part = picture[low[1] : high[1], low[0] : high[0]]
    part[...] = mean + (1 - cover) * part


def random_views(count, distance, angles, seed):
    """Poses that show a body's front at angles (rad) up to the largest, somewhere in the image."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        angle = random.uniform(*angles)
        about, spin = random.uniform(0, 2 * np.pi, 2)
        axis = np.array([np.cos(about), np.sin(about), 0.0])
        tilt = Pose(np.zeros(3), [*(np.sin(angle / 2) * axis), np.cos(angle / 2)])
        turn = Pose(np.zeros(3), [0.0, 0.0, np.sin(spin / 2), np.cos(spin / 2)])
        facing = Pose(np.zeros(3), [1.0, 0.0, 0.0, 0.0])
        place = np.array([*random.uniform(-0.15, 0.15, 2), 1.0]) * distance
        aim = _towards(place)
        yield Pose(place, (aim @ tilt @ facing @ turn).orientation)


def _towards(place):
    """The rotation that takes the optical axis to the line of sight of a place."""
    direction = place / np.linalg.norm(place)
    axis = np.cross([0.0, 0.0, 1.0], direction)
    return Pose(np.zeros(3), [*axis, 1.0 + direction[2]])
