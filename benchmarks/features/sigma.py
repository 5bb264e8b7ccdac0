# SPDX-License-Identifier: Apache-2.0
"""Tell whether the standard deviations are true.

(measured - true) / sigma of u, v and depth over simulated frames, and fused against both.

Depth: per mode and source. Pixels: a keypoint of one frame against its partner 0.3 s later, whose true place is known;
both standard deviations count. "std" is that of normalised errors below 5 (what is beyond is listed: edges, where a
keypoint has no single true depth). Fusion: the same left features with stereo, ToF and fused depth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.types import Features, FeatureSource
from slam_experiments.simulated.true_frames import TrueFrame, simulated_frames, spread, transfer, true_depth
from stereo_frontend.depth.depth_fusion import map_depth
from stereo_frontend.frontend import Frontend
from stereo_frontend.frontend_config import FrontendConfig

LIMIT = 5.0


def describe(label: str, error: np.ndarray, sigma: np.ndarray, unit: str = "mm", scale: float = 1e3) -> np.ndarray:
    known = np.isfinite(error) & np.isfinite(sigma)
    z = error[known] / sigma[known]
    core = np.abs(z) < LIMIT
    print(
        f"{label:16s}{known.sum():7d}{scale * spread(error):10.2f} {unit}{np.std(z[core]):9.2f}{spread(z):9.2f}"
        f"{100 * np.mean(~core):9.1f} %"
    )
    return z[core]


def header(title: str) -> None:
    print(f"\n{title}\n{'':16s}{'n':>7s}{'error':>13s}{'std z':>9s}{'robust':>9s}{'beyond 5':>11s}")


def depth_of_left(frames: list[TrueFrame], mode: str) -> list[Features]:
    frontend = Frontend(FrontendConfig(mode=mode))
    return [frontend.process(f.images, f.depth, f.T_left_tof) for f in frames]


def stereo_and_fusion(frames: list[TrueFrame]) -> dict[str, np.ndarray]:
    header("Depth of features in the left image")
    out = {}
    for mode in ("stereo", "replace", "fuse"):
        sets = depth_of_left(frames, mode)
        error = np.concatenate([s.depth - true_depth(f.truth, s.uv) for s, f in zip(sets, frames, strict=True)])
        sigma = np.concatenate([s.sigma_depth for s in sets])
        source = np.concatenate([s.source for s in sets])
        for kind in FeatureSource:
            if np.sum(source == kind) > 50:
                out[f"{mode} {kind.name}"] = describe(
                    f"{mode} {kind.name}", error[source == kind], sigma[source == kind]
                )
    return out


def tof_alone(frames: list[TrueFrame]) -> None:
    header("Depth of features in the ToF image")
    frontend = Frontend(FrontendConfig(mode="tof"))
    errors, sigmas = [], []
    for f in frames:
        features = frontend.process(None, f.depth)
        points = features.xyz @ f.T_left_tof[:3, :3].T + f.T_left_tof[:3, 3]
        pixels = f.images.stereo.camera.project(points.astype(np.float64))
        errors.append(points[:, 2] - true_depth(f.truth, pixels))
        sigmas.append(features.sigma_depth)
    describe("tof", np.concatenate(errors), np.concatenate(sigmas))


def pixels(frames: list[TrueFrame]) -> None:
    header("Place of keypoints seen again")
    sets = depth_of_left(frames, "stereo")
    errors, sigmas = [], []
    for k in range(len(frames) - 1):
        a, b = sets[k], sets[k + 1]
        moved = transfer(frames[k], frames[k + 1], a.uv)
        near = np.linalg.norm(np.nan_to_num(moved, nan=-1e4)[:, None] - b.uv[None], axis=2) < 4.0
        similarity = np.where(near, a.descriptors @ b.descriptors.T, -1.0)
        partner = similarity.argmax(axis=1)
        found = (similarity.max(axis=1) > 0.85) & (similarity.argmax(axis=0)[partner] == np.arange(len(a)))
        errors.append((b.uv[partner] - moved)[found])
        sigmas.append(np.hypot(a.sigma_uv, b.sigma_uv[partner])[found])
    for axis, name in enumerate("uv"):
        describe(name, np.concatenate(errors)[:, axis], np.concatenate(sigmas)[:, axis], "px", 1.0)


def fusion_against_both(frames: list[TrueFrame]) -> None:
    print(
        "\nCommon field of view: rms depth error of the same features, mm, and error of mapping into the ToF image, px"
    )
    stereo, fused = depth_of_left(frames, "stereo"), depth_of_left(frames, "fuse")
    rows, mapping = [], []
    for f, s, g in zip(frames, stereo, fused, strict=True):
        assert f.depth is not None
        both = [(i, j) for i, j in _same(s, g) if g.source[j] == FeatureSource.FUSED]
        i, j = (np.array(x) for x in zip(*both, strict=True))
        camera = f.images.stereo.camera
        tof = map_depth(s.uv[i], s.depth[i].astype(np.float64), camera, f.depth, f.T_left_tof)
        truth = true_depth(f.truth, s.uv[i])
        rows.append(np.column_stack([s.depth[i] - truth, tof.depth - truth, g.depth[j] - truth]))
        place = np.linalg.inv(f.T_left_tof) @ np.vstack([camera.unproject(s.uv[i], truth).T, np.ones(len(i))])
        mapping.append(np.linalg.norm(tof.uv - f.depth.camera.project(place[:3].T), axis=1))
    error = np.concatenate(rows)
    error = error[np.isfinite(error).all(axis=1)]
    rms = 1e3 * np.sqrt(np.mean(error**2, axis=0))
    print(f"stereo {rms[0]:.1f}   ToF {rms[1]:.1f}   fused {rms[2]:.1f}   ({len(error)} features)")
    distance = np.concatenate(mapping)
    print(f"mapping: median {np.nanmedian(distance):.3f} px, 99 % below {np.nanpercentile(distance, 99):.3f} px")


def _same(a: Features, b: Features) -> list[tuple[int, int]]:
    index = {tuple(uv): j for j, uv in enumerate(b.uv.tolist())}
    return [(i, index[tuple(uv)]) for i, uv in enumerate(a.uv.tolist()) if tuple(uv) in index]


def coverage(frames: list[TrueFrame], z: dict[str, FloatArray], path: Path) -> None:
    """Pictures: where features lie, and how often an error is below k sigma against what a Gaussian says."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from scipy.stats import chi

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5))
    uv = np.concatenate([s.uv for s in depth_of_left(frames, "stereo")])
    left.hist2d(uv[:, 0], uv[:, 1], bins=(32, 24))
    left.invert_yaxis()
    left.set_title("features in the image")
    k = np.linspace(0.0, 3.5, 71)
    for name, values in z.items():
        right.plot(k, [np.mean(np.abs(values) <= x) for x in k], label=name)
    right.plot(k, chi.cdf(k, 1), "k--", label="Gaussian")
    right.set(title="share of errors below k sigma", xlabel="k")
    right.legend()
    figure.savefig(path, dpi=110)
    print(f"\nfigure written to {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="small_room")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    frames = list(simulated_frames(arguments.scenario, arguments.frames, 3))
    z = stereo_and_fusion(frames)
    if frames[0].depth is not None:
        tof_alone(frames)
    pixels(frames)
    if frames[0].depth is not None:
        fusion_against_both(frames)
    if arguments.figure is not None:
        coverage(frames, z, arguments.figure)


if __name__ == "__main__":
    main()
