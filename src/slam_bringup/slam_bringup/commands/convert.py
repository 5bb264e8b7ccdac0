# SPDX-License-Identifier: Apache-2.0
"""``slam convert``: a public data set becomes a bag."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from slam_bags.datasets.euroc import EurocDataset
from slam_bags.datasets.files import Dataset
from slam_bags.datasets.kitti import KittiDataset
from slam_bags.datasets.rgbd import RgbdDataset
from slam_bags.storage.bag import COMPRESSIONS, BagWriter
from slam_bags.storage.bag_owner import require_free
from slam_bags.storage.sensor_writer import SensorWriter
from slam_bringup.terminal.console import is_quiet, progress_bar
from slam_bringup.terminal.paths import UserPath, overwrite_option

DATASETS: dict[str, Callable[[Path, Path | None, Path | None, float | None], Dataset]] = {
    "euroc": EurocDataset,
    "kitti": KittiDataset,
    "rgbd": RgbdDataset,
}


_OTHER_NAMES = {"tum": "rgbd", "7-scenes": "rgbd", "7scenes": "rgbd", "hololens": "rgbd", "asl": "euroc"}


class Kind(click.Choice[str]):
    """One of the kinds of data sets; a data set's own name leads to the kind that reads it."""

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The kind; a usage error that says which reads ``value`` if it is none."""
        if kind := _OTHER_NAMES.get(value.lower()):
            self.fail(f"'{value}' is read by {kind}: slam convert {kind} SOURCE -o BAG", param, ctx)
        return super().convert(value, param, ctx)


def convert(
    dataset: Dataset, target: Path, storage: str = "mcap", *, overwrite: bool = False, compression: str = "zstd"
) -> int:
    """Write a data set to a bag; returns the number of frames."""
    with BagWriter(target, storage, overwrite=overwrite, compression=compression) as bag, progress_bar() as progress:
        frames = dataset.write(SensorWriter(bag))
        for _ in progress.track(frames, description=f"writing {target.name}", total=len(dataset)):
            pass
    return len(dataset)


@click.command()
@click.argument("kind", type=Kind(sorted(DATASETS)))
@click.argument("source", type=UserPath())
@click.option("-o", "--output", type=UserPath(), required=True, help="the bag to write")
@click.option("--calibration", type=UserPath(), help="calibration, where the source has none")
@click.option("--ground-truth", type=UserPath(), help="poses, where the source has none")
@click.option(
    "--rate",
    type=click.FloatRange(0.1, 1000.0),
    help="frames per second, where the source has no stamps, or none that ascend",
)
@click.option("--storage", type=click.Choice(["mcap", "sqlite3"]), default="mcap", show_default=True)
@click.option(
    "--compression", type=click.Choice(COMPRESSIONS), default="zstd", show_default=True, help="compression of mcap bags"
)
@overwrite_option("a bag that slam wrote")
def command(
    kind: str,
    source: Path,
    output: Path,
    calibration: Path | None,
    ground_truth: Path | None,
    rate: float | None,
    storage: str,
    compression: str,
    overwrite: bool,
) -> None:
    """Convert a public data set to a bag, and say what of it is left out and what is assumed.

    KIND is euroc (folders with mav0, or key frames), kitti (odometry) or rgbd (7-Scenes, TUM RGB-D, plain folders of
    pictures and depth). Logs without images, such as MRCLAM's, have no place in a bag of images.
    """
    require_free(output, overwrite=overwrite)
    dataset = DATASETS[kind](source, calibration, ground_truth, rate)
    frames = convert(dataset, output, storage, overwrite=overwrite, compression=compression)
    if is_quiet():
        return
    click.echo(f"{output}: {frames} frames")
    for assumption in dataset.assumed:
        click.echo(f"assumed: {assumption}")
    for reason, count in dataset.left_out.items():
        if count:
            click.echo(f"left out: {count} {reason}")
