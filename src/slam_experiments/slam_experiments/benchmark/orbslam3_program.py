# SPDX-License-Identifier: Apache-2.0
"""ORB-SLAM3 over a folder of rectified pairs or of depth; ``orbslam3.py`` calls it with the interpreter that has it.

    python -P orbslam3_program.py FOLDER   # stamps.txt, left/*.png, right/*.png or depth/*.npy (m), settings.yaml

Writes FOLDER/trajectory.npz.

Needs numpy, OpenCV and orbslam3-python alone. The published vocabulary is not in the package: one in DBoW2's text
format (Galvez-Lopez and Tardos 2012: a tree of k-majority clusters, words weighted by how few pictures show them) is
trained on the folder's own pictures, which is if anything in ORB-SLAM3's favour.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2
import numpy as np
import orbslam3  # type: ignore[import-not-found]

BRANCHES, LEVELS, DEPTH = 10, 6, 4
"""Of the tree as it is declared, and levels that are made."""
_PICTURES, _FEATURES = 60, 600


def main() -> None:
    """Track the folder that is named on the command line."""
    folder = Path(sys.argv[1])
    stamps = np.loadtxt(folder / "stamps.txt", ndmin=1)
    has_depth = (folder / "depth").exists()
    chosen = sorted((folder / "left").iterdir())[:: max(1, len(stamps) // _PICTURES)]
    write_vocabulary(folder / "vocabulary.txt", chosen)
    sensor = orbslam3.Sensor.RGBD if has_depth else orbslam3.Sensor.STEREO
    system = orbslam3.System(str(folder / "vocabulary.txt"), str(folder / "settings.yaml"), sensor)
    system.set_use_viewer(False)
    system.initialize()
    start, began = time.process_time(), time.perf_counter()
    loading = 0.0
    for number, stamp in enumerate(stamps):
        before = time.process_time()
        left = cv2.imread(str(folder / "left" / f"{number:05d}.png"), cv2.IMREAD_GRAYSCALE)
        if has_depth:
            second = np.load(folder / "depth" / f"{number:05d}.npy")
        else:
            second = cv2.imread(str(folder / "right" / f"{number:05d}.png"), cv2.IMREAD_GRAYSCALE)
        loading += time.process_time() - before
        # As a camera gives them: the mapping threads work between pairs.
        time.sleep(max(0.0, began + (stamp - stamps[0]) - time.perf_counter()))
        (system.process_image_rgbd if has_depth else system.process_image_stereo)(left, second, float(stamp))
    cpu = time.process_time() - start - loading
    points = system.get_trajectory_points()
    np.savez(
        folder / "trajectory.npz",
        stamps=np.array([float(t) for t, _ in points]),
        T_camera_world=np.array([np.asarray(T, dtype=np.float64)[:3, :4] for _, T in points]),
        cpu_ms=1e3 * cpu / len(stamps),
    )
    system.shutdown()


def write_vocabulary(path: Path, pictures: list[Path]) -> None:
    """Train a tree on ORB descriptors of pictures and write it in DBoW2's text format."""
    orb, rng = cv2.ORB_create(_FEATURES), np.random.default_rng(0)  # type: ignore[attr-defined]
    described = [orb.detectAndCompute(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE), None)[1] for p in pictures]
    described = [d for d in described if d is not None]
    bits = np.unpackbits(np.concatenate(described), axis=1).astype(np.float32)
    picture = np.repeat(np.arange(len(described)), [len(d) for d in described])
    lines, waiting, count = [f"{BRANCHES} {LEVELS} 0 0"], [(0, np.arange(len(bits)), 1)], 0
    while waiting:  # breadth first: a node's number is that of its line
        parent, members, level = waiting.pop(0)
        for centre, own in clusters(bits, members, rng):
            count += 1
            is_leaf = level == DEPTH or len(own) < 2 * BRANCHES
            weight = np.log(len(described) / len(np.unique(picture[own]))) if is_leaf else 0.0
            numbers = " ".join(map(str, np.packbits(centre.astype(np.uint8)).tolist()))
            lines.append(f"{parent} {int(is_leaf)} {numbers} {weight:.6g}")
            if not is_leaf:
                waiting.append((count, own, level + 1))
    path.write_text("\n".join(lines) + "\n")


def clusters(bits: np.ndarray, members: np.ndarray, rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centres (256,) of 0 and 1 with their members, by k-majority."""
    own = bits[members]
    centres = own[rng.choice(len(own), min(BRANCHES, len(own)), replace=False)]
    for _ in range(6):
        distance = own.sum(axis=1)[:, None] + centres.sum(axis=1)[None] - 2.0 * own @ centres.T
        nearest = distance.argmin(axis=1)
        kept = np.unique(nearest)
        centres = np.array([own[nearest == k].mean(axis=0) > 0.5 for k in kept], dtype=np.float32)
    nearest = (own.sum(axis=1)[:, None] + centres.sum(axis=1)[None] - 2.0 * own @ centres.T).argmin(axis=1)
    return [(centres[k], members[nearest == k]) for k in np.unique(nearest)]


if __name__ == "__main__":
    main()
