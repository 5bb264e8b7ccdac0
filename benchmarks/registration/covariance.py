# SPDX-License-Identifier: Apache-2.0
"""NEES of many noisy registrations per motion: a mean of 6 is exact, far above 6 is a promise not kept.

In one place, all that differs from run to run is the noise. Noise and place stand for two parts of NEES by the mean
covariance: what differs, and what is the same in all runs, because the two views of one place show things from other
sides; a covariance can know of that only on average over places. So the second table spreads the runs over many places
of random rooms, where those that say that they are degenerate are counted apart. In the end corridor and single wall,
which must say so.
"""

from __future__ import annotations

import argparse

import numpy as np
from grid import ROOM
from rooms import EMPTY, empty_room, random_room
from scipy.stats import chi2

from ndt_registration.registration import RegistrationResult, register
from slam_core.geometry import FloatArray, boxminus
from slam_experiments.simulated.tof_scans import THESIS_MOTIONS, Motion, TofRoom, rig_motion, rig_pose, thinned

MOTIONS = ("forward 25 cm", "sideways 25 cm", "(25, 25) cm", "yaw +10 deg")
ROOMS = 20
"""Random rooms that the runs of the second table share."""


def noisy_registration(
    room: TofRoom, start: FloatArray, motion: Motion, rng: np.random.Generator
) -> tuple[RegistrationResult, FloatArray]:
    """Result, and error (6,), of registering two new scans from the truth."""
    truth = room.motion(motion)
    source, target = (thinned(room.scan(T, rng), 0.2, rng) for T in (start @ rig_motion(motion), start))
    result = register(source, target, truth)
    return result, boxminus(result.T_target_source, truth)


def row(name: str, errors: list[FloatArray], covariances: list[FloatArray]) -> str:
    nees = [d @ np.linalg.solve(P, d) for d, P in zip(errors, covariances, strict=True)]
    inside = np.mean(np.array(nees) < chi2.ppf(0.99, 6))
    return f"{name:20s} {np.mean(nees):6.2f} {np.median(nees):6.2f} {100 * inside:8.1f} %"


def one_place(scenario: str, runs: int) -> None:
    room, rng, start = TofRoom(scenario), np.random.default_rng(2), rig_pose(0.7, 1.9)
    print("one place            mean   median  below 99 % gate  noise  place")
    for name in MOTIONS:
        pairs = [noisy_registration(room, start, THESIS_MOTIONS[name], rng) for _ in range(runs)]
        errors, covariances = [d for _, d in pairs], [result.covariance for result, _ in pairs]
        common, information = np.mean(errors, axis=0), np.linalg.inv(np.mean(covariances, axis=0))
        noise, place = np.trace(information @ np.cov(np.transpose(errors))), common @ information @ common
        print(f"{row(name, errors, covariances)} {noise:13.2f} {place:6.2f}")


def many_places(runs: int, seed: int) -> None:
    print(f"\n{ROOMS} random rooms   mean   median  below 99 % gate  reported degenerate")
    rooms, rng = [random_room(seed + k) for k in range(ROOMS)], np.random.default_rng(seed)
    for name in MOTIONS:
        errors, covariances, degenerate = [], [], 0
        for k in range(runs):
            room, places = rooms[k % ROOMS]
            result, error = noisy_registration(room, next(places), THESIS_MOTIONS[name], rng)
            degenerate += bool(result.degenerate)
            if not result.degenerate:
                errors.append(error)
                covariances.append(result.covariance)
        print(f"{row(name, errors, covariances)} {degenerate:13d}")


def left_free(runs: int) -> None:
    print("\nleft free            said so   largest sigma, median")
    for name in EMPTY:
        (room, start), rng = empty_room(name), np.random.default_rng(3)
        results = [noisy_registration(room, start, THESIS_MOTIONS["forward 25 cm"], rng)[0] for _ in range(runs)]
        sigma = [np.sqrt(np.linalg.eigvalsh(result.covariance[:3, :3])[-1]) for result in results]
        said = sum(bool(result.degenerate) for result in results)
        print(f"{name:20s} {said:5d} of {runs} {np.median(sigma):8.2f} m: {'; '.join(results[0].degenerate)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--scenario", default=str(ROOM))
    parser.add_argument("--seed", type=int, default=100, help="of the random rooms")
    arguments = parser.parse_args()
    low, high = (chi2.ppf(p, 6 * arguments.runs) / arguments.runs for p in (0.025, 0.975))
    print(f"{arguments.runs} runs; 95 % bounds of the mean {low:.2f} ... {high:.2f}")
    one_place(arguments.scenario, arguments.runs)
    many_places(arguments.runs, arguments.seed)
    left_free(arguments.runs)


if __name__ == "__main__":
    main()
