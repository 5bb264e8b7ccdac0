# SPDX-License-Identifier: Apache-2.0
"""Sections 9.1.6 and 9.2: one filter over two rooms, and the submaps that take its place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slam_experiments import thesis
from slam_experiments.experiments import plots
from slam_experiments.experiments.chain import mapped
from slam_experiments.experiments.filter_maps import ERRORS, unknown_headings, variances_figure
from slam_experiments.experiments.filtering import (
    ACCURACY_HEADER,
    accuracy_row,
    bounds_comparison,
    end_comparison,
    frames,
    landmarks_comparison,
    speed_comparison,
)
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import Job, JobResult
from slam_experiments.thesis import Claim


def _one_filter() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        runs = {name: mapped("two_rooms", mapper=name, frames=frames(quick)) for name in ("ekf", "sjsam")}
        return runs | unknown_headings(20 if quick else 330)

    def report(results: Mapping[str, JobResult]) -> Findings:
        one, joined = results["ekf"], results["sjsam"]
        heading = np.degrees(np.sqrt(one.arrays["0 joined covariances"][-1, 5, 5]))
        error = one.values["agents"][0]["joined_end_deg"]
        anees = [r.values["agents"][0]["joined_anees"] for r in (one, joined)]
        unknown = [results[f"heading, {name}"].arrays["variances"][[0, -1], 2] for name in ERRORS]
        last = np.median(one.arrays["ms ekf"][-50:]), np.median(joined.arrays["ms ekf"][-50:])
        return Findings(
            comparisons=[
                landmarks_comparison(one, thesis.ONE_FILTER_LANDMARKS),
                Comparison("one filter: heading at the end", thesis.ONE_FILTER_HEADING,
                           f"claims {heading:.2f} deg, errs {error:.2f} deg"),
                Comparison("variance of a first heading that is unknown, standard and our error state, rad2",
                           thesis.HEADING_VARIANCE, ", ".join(f"{a:.2g} to {b:.2g}" for a, b in unknown),
                           "ours does not fall", bool(unknown[1][1] >= 0.999 * unknown[1][0])),
                Comparison("ANEES, one filter and joined submaps", thesis.ABSENT, f"{anees[0]:.2f}, {anees[1]:.2f}",
                           "submaps more consistent", abs(np.log(anees[1])) <= abs(np.log(anees[0]))),
                Comparison("time per frame at the end", thesis.ONE_FILTER_TIME, f"{last[0]:.0f} ms, with submaps "
                           f"{last[1]:.0f} ms", "submaps cheaper", bool(last[1] < last[0])),
                bounds_comparison("two_rooms", joined),
            ],
            tables=[Table("Accuracy", ACCURACY_HEADER, [accuracy_row("one filter", one),
                                                       accuracy_row("submaps, joined", joined)])],
            pictures=[
                Picture(plots.map_view(one.arrays), "9.17", "One filter between two rooms through a corridor."),
                Picture(plots.standard_deviations(one.arrays), "9.18", "Its standard deviations."),
                Picture(plots.times(one.arrays, "ekf"), "9.20", "One filter: time per frame grows with the map."),
                Picture(plots.map_view(joined.arrays), "", "The same rooms by joined submaps."),
                Picture(variances_figure(results), "6.4", "Round the workshop, association known: the standard error "
                        "state invents a heading, ours does not."),
            ],
        )  # fmt: skip

    return Experiment("one_filter", "6.2, 9.1.6", "Two rooms and a corridor in one filter", jobs, report)


def _joined(
    name: str,
    sections: str,
    title: str,
    claims: Mapping[str, Claim | str],
    mark_m: float | None,
    numbers: Mapping[str, str],
) -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        return {"run": mapped(name, frames=frames(quick))}

    def report(results: Mapping[str, JobResult]) -> Findings:
        run = results["run"]
        return Findings(
            _comparisons(name, run, claims, mark_m),
            [Table("Accuracy", ACCURACY_HEADER, [accuracy_row(name, run)])],
            [
                Picture(plots.submaps(run.arrays, "chained"), numbers["before"], "Submaps before joining."),
                Picture(plots.submaps(run.arrays, "joined"), numbers["after"], "The same submaps joined."),
                Picture(plots.map_view(run.arrays), numbers["after"], "Map from above."),
                Picture(plots.measurement_matrix(run.arrays), numbers["matrix"], "Pattern of the measurement matrix."),
                Picture(plots.standard_deviations(run.arrays), numbers["sigma"], "Standard deviations when joined."),
                Picture(plots.times(run.arrays, "sjsam"), numbers["times"], "Time to join each submap."),
            ],
        )

    return Experiment(name, sections, title, jobs, report)


def _comparisons(
    name: str, run: JobResult, claims: Mapping[str, Claim | str], mark_m: float | None
) -> list[Comparison]:
    summary, agent = run.values["summary"], run.values["agents"][0]
    merge = run.arrays["ms sjsam"]
    half = max(1, len(merge) // 2)
    comparisons = [
        landmarks_comparison(run, claims["landmarks"]),
        Comparison("submaps", claims["submaps"], str(summary["submaps"])),
        speed_comparison(run, claims["time"]),
        Comparison("joining, s", claims["joining"], f"{merge.sum() / 1e3:.1f} in all"),
        Comparison(
            "joining, ms a submap, first and second half",
            thesis.CLOSURES_COST,
            f"{np.mean(merge[:half]):.0f}, {np.mean(merge[-half:]):.0f}",
        ),
    ]
    if mark_m is not None:
        comparisons.append(end_comparison(run, claims["end"], mark_m))
    else:
        closed = summary["loop_closures"] > 0 and agent["joined_end_m"] < 0.01 * agent["path_m"]
        comparisons.append(
            Comparison(
                "loop",
                claims["end"],
                f"{summary['loop_closures']} closures, end error {1e3 * agent['joined_end_m']:.1f} mm",
                "closed, end error < 1 % of the way",
                closed,
            )
        )
    comparisons.append(bounds_comparison(name, run))
    drift = np.ptp(run.arrays["0 filter poses"][:, 2, 3])
    comparisons.append(Comparison("range of height before joining", claims["height"], f"{drift:.2f} m"))
    return comparisons


def _workshop() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        return {"run": mapped("workshop_rig", frames=frames(quick))}

    def report(results: Mapping[str, JobResult]) -> Findings:
        run = results["run"]
        before = run.values["agents"][0]["filter_end_m"]
        return Findings(
            comparisons=[
                Comparison("end error before joining", thesis.WORKSHOP_BEFORE, f"{1e3 * before:.1f} mm"),
                end_comparison(run, thesis.WORKSHOP_END, 0.02),
            ],
            pictures=[
                Picture(plots.submaps(run.arrays, "chained"), "9.26", "Submaps of the workshop."),
                Picture(plots.submaps(run.arrays, "joined"), "9.27", "Joined submaps of the workshop."),
            ],
        )

    return Experiment("workshop_joined", "9.2.4", "The workshop by joined submaps", jobs, report)


EXPERIMENTS = (
    _one_filter(),
    _joined(
        "figure_eight", "9.2.1-9.2.3", "Two rooms in a figure eight",
        {"landmarks": thesis.EIGHT_LANDMARKS, "submaps": thesis.EIGHT_SUBMAPS, "time": thesis.EIGHT_TIME,
         "joining": thesis.EIGHT_JOINING, "end": thesis.EIGHT_END, "height": thesis.ABSENT},
        0.06,
        {"before": "9.19", "after": "9.22", "matrix": "9.23", "sigma": "9.24", "times": "9.25"},
    ),
    _joined(
        "five_rooms", "9.2.1", "Five rooms, a loop of 70 m",
        {"landmarks": thesis.ABSENT, "submaps": thesis.ABSENT, "time": thesis.ROOMS_TIME,
         "joining": thesis.ROOMS_LOOP, "end": thesis.ROOMS_LOOP, "height": thesis.ROOMS_HEIGHT},
        None,
        {"before": "9.21", "after": "", "matrix": "", "sigma": "", "times": ""},
    ),
    _workshop(),
)  # fmt: skip
