# SPDX-License-Identifier: Apache-2.0
"""Section 9.1: the stereo camera alone, round the workshop, from a corner, in a sweep, round a table."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slam_experiments import thesis
from slam_experiments.experiments import plots
from slam_experiments.experiments.chain import mapped, yaw
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import Job, JobResult
from slam_experiments.simulated.expected import violations
from slam_experiments.thesis import Claim

_QUICK_FRAMES = 20
ACCURACY_HEADER = (
    "run", "frames", "landmarks", "submaps", "ATE mm", "end mm", "end deg", "ANEES", "filter alone: ATE mm",
    "processor s / s",
)  # fmt: skip


def frames(quick: bool) -> int | None:
    """Number of a scenario's frames that are used."""
    return _QUICK_FRAMES if quick else None


def accuracy_row(name: str, result: JobResult) -> list[str]:
    """A row below ``ACCURACY_HEADER``."""
    summary, agent = result.values["summary"], result.values["agents"][0]
    anees = agent.get("joined_anees")
    return [
        name, str(summary["frames"]), str(summary["landmarks"]), str(summary["submaps"]),
        *(f"{1e3 * agent[key]:.1f}" for key in ("joined_ate_m", "joined_end_m")), f"{agent['joined_end_deg']:.2f}",
        "" if anees is None else f"{anees:.2f}", f"{1e3 * agent['filter_ate_m']:.1f}",
        f"{result.values['processor_s'] / max(summary['sensor_s'], 1e-9):.2f}",
    ]  # fmt: skip


def end_comparison(result: JobResult, claim: Claim | str, mark_m: float) -> Comparison:
    """The error at the end of a loop beside the thesis's."""
    end = result.values["agents"][0]["joined_end_m"]
    return Comparison("end error", claim, f"{1e3 * end:.1f} mm", f"<= {1e3 * mark_m:.0f} mm", end <= mark_m)


def speed_comparison(result: JobResult, claim: Claim | str) -> Comparison:
    """Processor seconds of everything, dense model included, beside the seconds that the sensors recorded."""
    took, recorded = result.values["processor_s"], result.values["summary"]["sensor_s"]
    ours = f"{took:.0f} s of one core for {recorded:.0f} s recorded"
    return Comparison("time, features included", claim, ours, "real time on one core", took <= recorded)


def bounds_comparison(scenario: str, result: JobResult) -> Comparison:
    """True if the run keeps the bounds of ``bags/expected.yaml``."""
    outside = violations(scenario, result.values["summary"])
    return Comparison(
        f"bounds of bags/expected.yaml, {scenario}", "", "; ".join(outside) or "kept", "kept", not outside
    )


def landmarks_comparison(result: JobResult, claim: Claim | str) -> Comparison:
    """Number of landmarks beside the thesis's."""
    return Comparison("landmarks", claim, str(result.values["summary"]["landmarks"]))


def _workshop(
    name: str, claims: tuple[Claim, Claim | str, Claim], sections: str, title: str, numbers: tuple[str, ...]
) -> Experiment:
    """``claims``: of the thesis's landmarks, time and end error. It has one filter, which is run as well."""

    def jobs(quick: bool) -> Mapping[str, Job]:
        return {"run": mapped(name, frames=frames(quick)), "one": mapped(name, mapper="ekf", frames=frames(quick))}

    def report(results: Mapping[str, JobResult]) -> Findings:
        run, one = results["run"], results["one"]
        end = one.values["agents"][0]["joined_end_m"]
        views = [
            Picture(plots.map_view(run.arrays, 1), numbers[0], "Map from above."),
            Picture(plots.map_view(run.arrays, 2), numbers[1], "From the side."),
            Picture(plots.map_in_3d(run.arrays), numbers[2], "In three dimensions."),
            Picture(
                plots.standard_deviations(run.arrays, kind="filter"),
                numbers[3],
                "Standard deviations of the filter, within its own odometry.",
            ),
            Picture(plots.standard_deviations(run.arrays), numbers[3], "The same of the joined map."),
        ]
        return Findings(
            comparisons=[
                landmarks_comparison(run, claims[0]),
                speed_comparison(run, claims[1]),
                end_comparison(run, claims[2], 0.015),
                Comparison("end error of one filter, as the thesis has", claims[2], f"{1e3 * end:.1f} mm"),
                bounds_comparison(name, run),
            ],
            tables=[
                Table(
                    "Accuracy against the simulated truth",
                    ACCURACY_HEADER,
                    [accuracy_row(name, run), accuracy_row("one filter", one)],
                )
            ],
            pictures=views,
        )

    return Experiment(name, sections, title, jobs, report)


def _fireman() -> Experiment:
    rates = ("fireman_10hz", "fireman_5hz")

    def jobs(quick: bool) -> Mapping[str, Job]:
        return {name: mapped(name, frames=frames(quick)) for name in rates}

    def report(results: Mapping[str, JobResult]) -> Findings:
        comparisons = []
        for name, claim in zip(rates, (thesis.FIREMAN_10HZ, thesis.FIREMAN_5HZ), strict=True):
            summary = results[name].values["summary"]
            lost = sum("LOST" in event for event in summary["events"])
            end = results[name].values["agents"][0]["joined_end_m"]
            comparisons.append(
                Comparison(
                    f"{name.removeprefix('fireman_')}, looking round",
                    claim,
                    f"lost {lost} times, end error {1e3 * end:.1f} mm",
                    "never lost, <= 15 mm",
                    lost == 0 and end <= 0.015,
                )
            )
        comparisons += [bounds_comparison(name, results[name]) for name in rates]
        rows = [accuracy_row(name, results[name]) for name in rates]
        pictures = [
            Picture(plots.map_view(results["fireman_10hz"].arrays), "9.9", "10 frames a second."),
            Picture(plots.standard_deviations(results["fireman_10hz"].arrays), "9.10", "Its standard deviations."),
            Picture(plots.map_view(results["fireman_5hz"].arrays), "9.11", "Every second pair only."),
        ]
        return Findings(comparisons, [Table("Accuracy", ACCURACY_HEADER, rows)], pictures)

    return Experiment("fireman", "9.1.3", "A fireman looks round a room from a corner", jobs, report)


def _sweep() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        return {"run": mapped("sweep", frames=frames(quick))}

    def report(results: Mapping[str, JobResult]) -> Findings:
        run = results["run"]
        turned = [np.degrees(np.ptp(yaw(run.arrays[f"0 joined {kind}"]))) for kind in ("poses", "truth")]
        error = abs(turned[0] - turned[1])
        angle, rate = plots.angles(run.arrays)
        return Findings(
            comparisons=[
                Comparison(
                    "angle swept",
                    thesis.SWEEP,
                    f"{turned[0]:.2f} of {turned[1]:.2f} deg",
                    "within 0.5 deg",
                    bool(error <= 0.5),
                ),
                bounds_comparison("sweep", run),
            ],
            tables=[Table("Accuracy", ACCURACY_HEADER, [accuracy_row("sweep", run)])],
            pictures=[
                Picture(plots.map_view(run.arrays), "9.12", "The sweep from above."),
                Picture(angle, "9.13", "Angles."),
                Picture(rate, "9.14", "Angular velocities."),
            ],
        )

    return Experiment("sweep", "9.1.4", "A sweep of 90 degrees checks the angles", jobs, report)


def _conference() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        return {"run": mapped("conference", frames=frames(quick))}

    def report(results: Mapping[str, JobResult]) -> Findings:
        run = results["run"]
        return Findings(
            comparisons=[
                landmarks_comparison(run, thesis.CONFERENCE_LANDMARKS),
                speed_comparison(run, thesis.CONFERENCE_TIME),
                end_comparison(run, thesis.ABSENT, 0.015),
                bounds_comparison("conference", run),
            ],
            tables=[Table("Accuracy", ACCURACY_HEADER, [accuracy_row("conference", run)])],
            pictures=[
                Picture(plots.map_view(run.arrays), "9.15", "Map from above."),
                Picture(plots.standard_deviations(run.arrays), "9.16", "Standard deviations."),
            ],
        )

    return Experiment("conference", "9.1.5", "Round the table of a conference room", jobs, report)


EXPERIMENTS = (
    _workshop(
        "workshop_rig",
        (thesis.RIG_LANDMARKS, thesis.RIG_TIME, thesis.RIG_END),
        "9.1.1",
        "A loop round the workshop, camera on a rig",
        ("9.2", "9.3", "9.4", "9.5"),
    ),
    _workshop(
        "workshop_handheld",
        (thesis.HAND_LANDMARKS, thesis.ABSENT, thesis.HAND_END),
        "9.1.2",
        "The same loop, camera in the hand",
        ("9.7", "9.3", "9.4", "9.8"),
    ),
    _fireman(),
    _sweep(),
    _conference(),
)
