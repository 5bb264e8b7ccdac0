# SPDX-License-Identifier: Apache-2.0
"""The same scans by PCL's NDT and ICP, small_gicp, Open3D, and ours.

Successes (5 cm, 1 deg) and milliseconds, build and align.

PCL is built here from pcl.cpp (Debian: libpcl-dev); small_gicp and Open3D are imported where they are installed.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from grid import ROOM

from ndt_registration.registration import register
from slam_core.geometry import FloatArray, boxminus
from slam_experiments.simulated.tof_scans import SCANS, THESIS_MOTIONS, TofRoom, rig_motion, rig_pose, thinned

HERE = Path(__file__).parent
Method = Callable[[FloatArray, FloatArray], tuple[FloatArray, float]]


def ours(source: FloatArray, target: FloatArray) -> tuple[FloatArray, float]:
    began = time.perf_counter()
    T = register(source, target).T_target_source
    return T, 1e3 * (time.perf_counter() - began)


def build_pcl(folder: Path) -> Path:
    """Compile pcl.cpp against the installed PCL."""
    includes = [f"-I{path}" for path in ("/usr/include/eigen3", *Path("/usr/include").glob("pcl-*"))]
    libraries = ["-lpcl_registration", "-lpcl_search", "-lpcl_kdtree", "-lpcl_filters", "-lpcl_common"]
    program = folder / "pcl"
    source = str(HERE / "pcl.cpp")
    subprocess.run(["g++", "-O3", "-std=c++17", *includes, source, "-o", str(program), *libraries], check=True)
    return program


def pcl(program: Path, method: str, size: float) -> Method:
    def run(source: FloatArray, target: FloatArray) -> tuple[FloatArray, float]:
        with tempfile.TemporaryDirectory() as folder:
            paths = [Path(folder) / name for name in ("source", "target")]
            for path, cloud in zip(paths, (source, target), strict=True):
                np.savetxt(path, cloud, fmt="%.5f")
            command = [str(program), method, str(size), *(str(p) for p in paths)]
            words = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        return np.array(words[1:], dtype=float).reshape(4, 4), float(words[0])

    return run


def small_gicp(kind: str, threads: int) -> Method:
    import small_gicp as library

    def run(source: FloatArray, target: FloatArray) -> tuple[FloatArray, float]:
        began = time.perf_counter()
        result = library.align(
            target,
            source,
            registration_type=kind,
            downsampling_resolution=0.02,
            max_correspondence_distance=1.0,
            num_threads=threads,
        )
        return np.asarray(result.T_target_source), 1e3 * (time.perf_counter() - began)

    return run


def open3d(kind: str) -> Method:
    import open3d as library

    def run(source: FloatArray, target: FloatArray) -> tuple[FloatArray, float]:
        began = time.perf_counter()
        clouds = []
        for points in (source, target):
            cloud = library.geometry.PointCloud(library.utility.Vector3dVector(points))
            cloud = cloud.voxel_down_sample(0.02)
            cloud.estimate_normals(library.geometry.KDTreeSearchParamKNN(20))
            clouds.append(cloud)
        registration = library.pipelines.registration
        estimation = (
            registration.TransformationEstimationForGeneralizedICP()
            if kind == "gicp"
            else registration.TransformationEstimationPointToPlane()
        )
        align = registration.registration_generalized_icp if kind == "gicp" else registration.registration_icp
        criteria = registration.ICPConvergenceCriteria(max_iteration=100)
        result = align(clouds[0], clouds[1], 1.0, np.eye(4), estimation, criteria)
        return np.asarray(result.transformation), 1e3 * (time.perf_counter() - began)

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=SCANS)
    parser.add_argument("--scenario", default=str(ROOM))
    parser.add_argument("--share", type=float, default=0.2, help="share of the points")
    parser.add_argument("--only", default="", help="methods whose name contains this")
    arguments = parser.parse_args()
    methods: dict[str, Method] = {"ours": ours}
    folder = Path(tempfile.mkdtemp())
    try:
        program = build_pcl(folder)
        methods |= {"PCL NDT 0.5 m": pcl(program, "ndt", 0.5), "PCL ICP 0.5 m": pcl(program, "icp", 0.5)}
    except (subprocess.CalledProcessError, FileNotFoundError) as error:
        print(f"without PCL: {error}")
    try:
        for threads in (1, 2):
            methods |= {f"small_gicp {kind}, {threads}": small_gicp(kind, threads) for kind in ("GICP", "PLANE_ICP")}
    except ImportError as error:
        print(f"without small_gicp: {error}")
    try:
        methods |= {"Open3D plane": open3d("plane"), "Open3D GICP": open3d("gicp")}
    except ImportError as error:
        print(f"without Open3D: {error}")
    share = arguments.share
    room, rng, start = TofRoom(arguments.scenario), np.random.default_rng(1), rig_pose(0.7, 1.9)
    ours(room.scan(start, rng)[:8000], room.scan(start, rng)[:8000])  # compiles
    print(f"{'method':24s} successes of {arguments.scans} per motion, median ms\n{'':24s} {', '.join(THESIS_MOTIONS)}")
    pairs = {
        name: [
            (thinned(room.scan(start @ rig_motion(m), rng), share, rng), thinned(room.scan(start, rng), share, rng))
            for _ in range(arguments.scans)
        ]
        for name, m in THESIS_MOTIONS.items()
    }
    for name, method in ((n, m) for n, m in methods.items() if arguments.only in n):
        successes, times = [], []
        for motion, clouds in pairs.items():
            truth, count = room.motion(THESIS_MOTIONS[motion]), 0
            for source, target in clouds:
                T, ms = method(source, target)
                d = boxminus(T, truth)
                count += bool(np.linalg.norm(d[:3]) < 0.05 and np.linalg.norm(d[3:]) < np.deg2rad(1.0))
                times.append(ms)
            successes.append(count)
        print(f"{name:24s} {'/'.join(map(str, successes))}  {np.median(times):.0f} ms", flush=True)


if __name__ == "__main__":
    main()
