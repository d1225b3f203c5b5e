"""The scanned meshes, at the poses of the real frames, land on the frames' masks.

All objects of a frame are drawn in one z-buffer through the frame's own camera. The origins of the scans are not those
of the poses: each object gets one translation, fitted to the depth of some frames of each scene and scored on the
others.
"""

from collections import defaultdict

import numpy as np
import pytest
import torch
import trimesh
from posed_scenes import z_buffer
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from neural_sim.cameras import rays
from neural_sim.objects.ycb import YCB
from neural_sim.target.ycb_video import YcbVideoTarget

pytestmark = pytest.mark.slow
OPENCV = np.array([1.0, -1.0, -1.0])
FITTED, SCORED = (1, 3, 5), (2, 4)
LEAST = 1000
"""Pixels of a mask that counts."""


def directions(frame):
    """Rays of the project's camera in OpenCV axes, with z = 1."""
    bundle = rays(frame.camera, torch.eye(4, dtype=torch.float64)).directions.numpy() * OPENCV
    return bundle / bundle[..., 2:]


def surface_points(frames, name, limit=6000):
    """Points that the depth camera saw on an object, in its poses' frame; without its outline, where depth mixes."""
    points = []
    for frame in frames:
        for item in frame.objects:
            if item.name == name:
                seen = binary_erosion(item.mask, iterations=3) & (frame.depth > 0.0)
                local = directions(frame)[seen] * frame.depth[seen][:, None]
                points.append((local - item.object_to_camera[:3, 3]) @ item.object_to_camera[:3, :3])
    joined = np.concatenate(points)
    return joined[np.random.default_rng(0).permutation(len(joined))[:limit]]


def fitted_translation(points, mesh, damping=1e-3, rounds=60):
    """The translation of a mesh on to points: iterated closest points, distances to tangent planes, the farthest tenth
    of the points left out. It starts with the box's centre at the origin; ``damping`` shortens steps in directions in
    which the seen part of the surface may slide."""
    surface, face = trimesh.sample.sample_surface(mesh, 40000, seed=0)
    normals, tree, moved = mesh.face_normals[face], cKDTree(surface), -mesh.bounds.mean(0)
    for _ in range(rounds):
        distance, nearest = tree.query(points - moved)
        kept = distance <= np.quantile(distance, 0.9)
        normal = normals[nearest][kept]
        off = ((points - moved - surface[nearest])[kept] * normal).sum(1)
        step = np.linalg.solve(normal.T @ normal / len(off) + damping * np.eye(3), normal.T @ off / len(off))
        moved = moved + step
        if np.abs(step).max() < 1e-6:
            break
    return moved


def overlaps(frames, meshes, translations):
    """IoU of each object's visible pixels with its real mask, by object."""
    scored = defaultdict(list)
    for frame in frames:
        placed = [
            meshes[item.name].copy().apply_translation(translations[item.name]) for item in frame.objects
        ]
        labels, _, _ = z_buffer(placed, [item.object_to_camera for item in frame.objects], directions(frame))
        for number, item in enumerate(frame.objects, 1):
            if item.mask.sum() > LEAST:
                drawn = labels == number
                scored[item.name].append((drawn & item.mask).sum() / (drawn | item.mask).sum())
    return scored


def median(scored):
    return float(np.median(np.concatenate(list(scored.values()))))


def test_meshes_land_on_the_real_masks(shared_data):
    root = shared_data / "ycb_video_sample"
    if not root.is_dir():
        pytest.skip(f"no real frames: {root} does not exist")
    target = YcbVideoTarget(root, every=1)
    frames = [target.reader.frame(name, depth=True) for part in target.parts(0).values() for name in part]
    names = sorted({item.name for frame in frames for item in frame.objects})
    meshes = {}
    for item in YCB(shared_data / "ycb", names).load():
        bare = trimesh.Trimesh(item.mesh.vertices, item.mesh.faces, process=False)
        meshes[item.name] = bare.apply_transform(item.transform)
    seen = [frame for frame in frames if frame.number in FITTED]
    scored = [frame for frame in frames if frame.number in SCORED]
    assert len(seen) == 9 and len(scored) == 6
    fitted = {name: fitted_translation(surface_points(seen, name), meshes[name]) for name in names}
    found = overlaps(scored, meshes, fitted)
    centred = overlaps(scored, meshes, {name: -mesh.bounds.mean(0) for name, mesh in meshes.items()})
    asis = overlaps(scored, meshes, {name: np.zeros(3) for name in names})
    for name in names:
        print(f"{name}: {1e3 * np.linalg.norm(fitted[name]):.0f} mm off, IoU {np.mean(found[name]):.3f}, box's centre "
              f"{np.mean(centred[name]):.3f}, as scanned {np.mean(asis[name]):.3f}")  # fmt: skip
    print(
        f"median of {sum(map(len, found.values()))}: {median(found):.3f}, {median(centred):.3f}, {median(asis):.3f}"
    )
    assert sum(map(len, found.values())) >= 24
    assert median(found) > 0.85
    assert median(found) > median(centred) > median(asis)  # the origins differ, and the fit says by how much
