# SPDX-License-Identifier: Apache-2.0
"""Real pairs of clouds without an initial guess: depth cameras some tenths of a metre apart, and public clouds.

    python benchmarks/registration/clouds.py --data FOLDER [--method ndt icp icp_plane] [--every N]

Frames of 7-Scenes redkitchen and of a HoloLens, each with the first one 0.1, 0.2, 0.3 and 0.5 m away, as a whole and
cut to the view of an SR4000 (43.6 by 34.6 deg). A pair is right within 60 mm and 2.5 deg of the recording's poses, or
50 mm and 2 deg of GICP that starts there (small_gicp, needed). Wrong: claimed all the same. NEES over 6: against the
poses, which err themselves by the millimetres and degrees that are printed, and against GICP, which errs as much as the
registration, so that 2 would be honest where their errors were independent. Public clouds have no truth but where a
difference is printed.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from ndt_registration.clouds.cloud_io import read_cloud
from ndt_registration.registration import RegistrationConfig, RegistrationResult, register
from slam_core.geometry import FloatArray, boxminus, invert_transform, make_transform, so3_log, transform_from_pose7

TUTORIAL = "cloud_libpointmatcher/icp_tutorial"
RGBD = "rgbd_slambook5/ch5/rgbd"
SLAMBOOK = np.array([[518.0, 0.0, 325.5], [0.0, 519.0, 253.5], [0.0, 0.0, 1.0]])
REDKITCHEN = np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]])
STEPS = (0.1, 0.2, 0.3, 0.5)
LARGEST_TURN_DEG = 25.0
NARROW = np.tan(np.deg2rad(np.array([43.6, 34.6]) / 2.0))
RANGES = (0.3, 6.0)
TRUTH_SIGMA = {"redkitchen": (0.01, 0.005), "hololens": (0.005, 0.003)}
"""Standard deviation of the relative poses of frames some tenths of a metre apart, m and rad."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds (n, 3) m, and T_target_source where it is known."""

    name: str
    source: FloatArray
    target: FloatArray
    truth: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Recording:
    """Files of depth images in mm, their camera matrix (3, 3), poses T_world_camera, and every so many pixels used."""

    files: list[Path]
    K: FloatArray
    poses: list[FloatArray]
    stride: int

    def pairs(self, every: int, *, narrow: bool) -> Iterator[Pair]:
        """Every so many frames with the first later ones that are ``STEPS`` m away and have not turned far."""
        for k in range(0, len(self.poses), every):
            for step in STEPS:
                apart = np.linalg.norm([T[:3, 3] - self.poses[k][:3, 3] for T in self.poses[k:]], axis=1)
                j = k + int(np.argmax(apart >= step))
                truth = invert_transform(self.poses[k]) @ self.poses[j]
                if j > k and degrees(so3_log(truth[:3, :3])) <= LARGEST_TURN_DEG:
                    source, target = (
                        depth_points(self.files[i], self.K, self.stride, narrow=narrow, ranges=RANGES) for i in (j, k)
                    )
                    yield Pair(f"{j} to {k}", source, target, truth)


def recordings(data: Path) -> dict[str, Recording]:
    kitchen, headset = data / "rgbd_tsdf_1000/data", data / "hololens_office_120"
    depth, poses = sorted(kitchen.glob("*.depth.png"))[:200], sorted(kitchen.glob("*.pose.txt"))[:200]
    tracked = np.loadtxt(headset / "poses.txt").reshape(-1, 4, 4)
    return {
        "redkitchen": Recording(depth, REDKITCHEN, [rigid(np.loadtxt(path)) for path in poses], 3),
        "hololens": Recording(
            sorted((headset / "depth").glob("*.png")), np.loadtxt(headset / "K.txt"), [rigid(T) for T in tracked], 2
        ),
    }


def public(data: Path) -> Iterator[Pair]:
    yield Pair("ETH apartment", *(read_cloud(data / TUTORIAL / f"cloud_{k}.vtk") for k in (1, 0)))
    lidar = data / "cloud_small_gicp/data"
    truth = rigid(np.loadtxt(lidar / "T_target_source.txt"))
    yield Pair("vehicle lidar", read_cloud(lidar / "source.ply"), read_cloud(lidar / "target.ply"), truth)
    captures = [read_cloud(data / f"cloud_pcl_pairwise/pairwise/capture000{k}.pcd") for k in range(1, 6)]
    for k, (target, source) in enumerate(pairwise(captures), start=1):
        yield Pair(f"PCL {k + 1} to {k}", source, target)
    poses = transform_from_pose7(np.loadtxt(data / RGBD / "pose.txt"))
    views = [depth_points(data / RGBD / "depth" / f"{k}.pgm", SLAMBOOK, 3) for k in range(1, 6)]
    for a, b in pairwise(range(5)):
        yield Pair(f"slambook {b + 1} to {a + 1}", views[b], views[a], invert_transform(poses[a]) @ poses[b])


def depth_points(
    path: Path, K: FloatArray, stride: int, *, narrow: bool = False, ranges: tuple[float, float] = (0.0, np.inf)
) -> FloatArray:
    """Points (n, 3) m in the optical frame of a depth image in mm."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    z = image[::stride, ::stride].astype(np.float64) / 1000.0
    v, u = np.mgrid[0 : image.shape[0] : stride, 0 : image.shape[1] : stride]
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    valid = (z > ranges[0]) & (z < ranges[1])
    if narrow:
        valid &= (np.abs(x) < NARROW[0]) & (np.abs(y) < NARROW[1])
    return np.stack([x * z, y * z, z], axis=-1)[valid]


def gicp(pair: Pair) -> FloatArray:
    """T_target_source by small_gicp from the truth."""
    import small_gicp as library

    result = library.align(
        pair.target, pair.source, init_T_target_source=pair.truth, registration_type="GICP",
        downsampling_resolution=0.02, max_correspondence_distance=0.2, num_threads=1,
    )  # fmt: skip
    return rigid(np.asarray(result.T_target_source))


@dataclass(frozen=True, eq=False)
class Row:
    """A pair registered: differences (6,) from the poses and from GICP, processor milliseconds."""

    result: RegistrationResult
    from_truth: FloatArray
    from_gicp: FloatArray
    milliseconds: float

    @property
    def right(self) -> bool:
        """True if the pose is that of the recording or of GICP."""
        return within(self.from_truth, 0.06, 2.5) or within(self.from_gicp, 0.05, 2.0)

    def nees(self, error: FloatArray, sigma: tuple[float, float] = (0.0, 0.0)) -> float:
        """Normalised squared error over 6 where what it is measured by has so large an error itself."""
        covariance = self.result.covariance + np.diag(np.repeat(sigma, 3)) ** 2
        return float(error @ np.linalg.solve(covariance, error)) / 6.0


def within(error: FloatArray, distance: float, angle_deg: float) -> bool:
    return bool(np.linalg.norm(error[:3]) < distance and degrees(error[3:]) < angle_deg)


def registered(pairs: Iterable[Pair], method: str) -> list[Row]:
    rows = []
    for pair in pairs:
        assert pair.truth is not None
        began = time.thread_time()
        result = register(pair.source, pair.target, config=RegistrationConfig(method=method))
        took = 1e3 * (time.thread_time() - began)
        T = result.T_target_source
        rows.append(Row(result, boxminus(T, pair.truth), boxminus(T, gicp(pair)), took))
    return rows


def summary(name: str, method: str, rows: list[Row]) -> str:
    right = [row for row in rows if row.right]
    good = [row for row in right if row.result.converged]
    wrong = sum(row.result.converged and not row.right for row in rows)
    refused = Counter(row.result.reason.split(":")[0] for row in rows if not row.result.converged)
    sigma = TRUTH_SIGMA[name.split(",")[0]]
    truth = [row.nees(row.from_truth, sigma) for row in good]
    peer = [row.nees(row.from_gicp) for row in good]
    apart = [
        1e3 * np.median([np.linalg.norm(e[:3]) for e in d])
        for d in zip(*((r.from_truth, r.from_gicp) for r in good), strict=True)
    ]
    said = "; ".join(f"{count} {reason}" for reason, count in refused.most_common())
    return (
        f"{name:18s} {method:9s} {len(rows):5d} {len(right):5d} {len(good):7d} {wrong:5d} "
        f"{apart[0]:7.1f} {apart[1]:5.1f}  "
        f"{np.median(truth):5.2f} {np.mean(truth):5.2f} {np.percentile(truth, 95):5.1f}  "
        f"{np.median(peer):6.1f} {np.mean(peer):5.1f}  {np.median([row.milliseconds for row in rows]):5.0f}  {said}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--method", nargs="+", default=["ndt", "icp", "icp_plane"])
    parser.add_argument("--every", type=int, default=10, help="a target every so many frames")
    arguments = parser.parse_args()
    for name, sigma in TRUTH_SIGMA.items():
        print(f"{name}: poses err by {1e3 * sigma[0]:.0f} mm and {degrees(np.array([sigma[1]])):.2f} deg")
    print(f"{'':28s} {'':5s} {'':5s} right,       mm to the       NEES: poses    NEES: GICP")
    print(
        f"{'pairs':18s} {'method':9s} {'':5s} right claimed wrong   poses  GICP "
        "median  mean  95 %  median  mean     ms  refused"
    )
    for name, recording in recordings(arguments.data).items():
        for narrow in (False, True):
            pairs = list(recording.pairs(arguments.every, narrow=narrow))
            for method in arguments.method:
                print(summary(f"{name}{', narrow' if narrow else ''}", method, registered(pairs, method)), flush=True)
    for pair in public(arguments.data):
        for method in arguments.method:
            print(report(pair, method), flush=True)


def report(pair: Pair, method: str) -> str:
    result = register(pair.source, pair.target, config=RegistrationConfig(method=method))
    T = result.T_target_source
    text = f"{pair.name:16s} {method:9s} {'claimed' if result.converged else 'refused'} t {np.round(T[:3, 3], 3)} m, "
    text += f"{degrees(so3_log(T[:3, :3])):.2f} deg, overlap {result.overlap:.2f}"
    if pair.truth is not None:
        d = boxminus(T, pair.truth)
        text += f"; {1e3 * np.linalg.norm(d[:3]):.0f} mm and {degrees(d[3:]):.2f} deg from the truth"
    return f"{text} {result.reason}"


def degrees(rotation: FloatArray) -> float:
    return float(np.rad2deg(np.linalg.norm(rotation)))


def rigid(T: FloatArray) -> FloatArray:
    """The transform with the nearest rotation: files round."""
    left, _, right = np.linalg.svd(T[:3, :3])
    return make_transform(left @ right, T[:3, 3])


if __name__ == "__main__":
    main()
