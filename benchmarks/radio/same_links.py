# SPDX-License-Identifier: Apache-2.0
"""Claimed sigma of light submaps, and of those with details, where the map has the links of whole ones and no others.

    OPENBLAS_NUM_THREADS=1 python benchmarks/radio/same_links.py RUN ...

RUN: the folder of a run with its ``map``. Whole submaps are joined; of the matches that their map holds those remain
whose landmarks are in the light submaps too. All three forms are then placed and solved with these. Printed are the
claimed sigma of the submaps' ends over that of whole submaps (median and least), the map's variance factor, and the
same ratio without that factor, which is what the submaps themselves claim.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from light_submaps import messages, unpacked
from rich.console import Console
from rich.table import Table

from sjsam_node.global_map import GlobalMap
from sjsam_node.graph.links import Link
from sjsam_node.map_file import storage
from slam_core.geometry import FloatArray
from slam_core.types import Submap
from slam_radio.packing.light_submap import LightConfig, pack, unpack


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    table = Table("run", "submaps", "sigma", "least", "variance factor", "sigma without it", "least")
    for run in parser.parse_args().runs:
        joined = GlobalMap()
        for record in storage.read(run / "map").state.graph.records:
            joined.add(record.submap)
        joined.settle()
        whole = [r.submap for r in joined.estimate.graph.records]
        light = [unpack(pack(s)) for s in whole]
        known = [set(s.landmark_ids.tolist()) for s in light]
        forms = {"whole": whole, "light": light,
                 "with details": [unpacked(*messages(s, LightConfig(), True)) for s in whole]}  # fmt: skip
        found = {name: solved(form, [linked(k, whole, form, known) for k in joined.estimate.graph.links])
                 for name, form in forms.items()}  # fmt: skip
        first, least_factor = found["whole"]
        for name, (sigma, factor) in found.items():
            ratio = sigma[1:] / first[1:]
            own = ratio / np.sqrt(factor / least_factor)
            cells = (f"{np.median(ratio):.2f}", f"{ratio.min():.2f}", f"{factor:.1f}", f"{np.median(own):.2f}")
            table.add_row(run.name, name, *cells, f"{own.min():.2f}")
    Console(width=120).print(table)


def linked(link: Link, whole: Sequence[Submap], form: Sequence[Submap], known: Sequence[set[int]]) -> Link:
    """A link of whole submaps between the same landmarks of another form, as far as light submaps have them."""
    rows = [{i: row for row, i in enumerate(form[end].landmark_ids.tolist())} for end in link.ends]
    ids = [
        tuple(int(whole[end].landmark_ids[i]) for end, i in zip(link.ends, pair, strict=True)) for pair in link.pairs
    ]
    kept = [(rows[0][i], rows[1][j]) for i, j in ids if i in known[link.first] and j in known[link.second]]
    return replace(link, pairs=np.array(kept, dtype=np.int64).reshape(-1, 2))


def solved(submaps: Sequence[Submap], links: Sequence[Link]) -> tuple[FloatArray, float]:
    """Claimed sigma (n,) m of the submaps' ends, and the variance factor of the largest part of the map."""
    joined = GlobalMap()
    for submap in submaps:
        joined._place(submap)
    joined.estimate.add_links(links)
    joined.estimate.optimize_full(coarse=True)
    joined.estimate.optimize_full()
    joined.estimate.relinearize()
    snapshot, state = joined.snapshot(), joined.state
    sigma = [np.sqrt(np.trace(snapshot.end(record).covariance[:3, :3])) for record in range(len(snapshot))]
    return np.array(sigma), max(1.0, state.result(state.component(0)).variance_factor)


if __name__ == "__main__":
    main()
