# SPDX-License-Identifier: Apache-2.0
"""The commands of this package, which it registers at ``slam`` by the entry point group ``slam.commands``."""

COMMANDS = {
    "simulate": ("slam_experiments.commands.simulate", "render a scenario to a bag with ground truth"),
    "experiment": ("slam_experiments.commands.experiment", "the experiments of the thesis, beside its own figures"),
    "benchmark": (
        "slam_experiments.commands.benchmark",
        "recordings with ground truth, in variants, beside other programs",
    ),
    "plane": ("slam_experiments.commands.plane", "2D SLAM on range-bearing logs of one or several robots"),
    "join": ("slam_experiments.commands.join", "join text submaps of the Linear SLAM format"),
}
"""By name: the module that holds its ``command``, and one line of help."""
