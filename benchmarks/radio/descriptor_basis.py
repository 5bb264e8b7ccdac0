# SPDX-License-Identifier: Apache-2.0
"""Finds the directions of ``slam_radio.packing.descriptor_code`` anew: principal ones of a simulated map's descriptors.

    python benchmarks/radio/descriptor_basis.py MAP [-o surf128_basis.npy]

MAP: the folder ``map`` of a run on simulated rooms, ``bags/demo`` for those that are shipped. Recordings of users or
of others take no part in them. Prints the share of the squares that the directions hold.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sjsam_node.map_file import storage
from slam_radio.packing.descriptor_code import DIRECTIONS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    records = storage.read(arguments.map).state.graph.records
    descriptors = np.concatenate([r.submap.descriptors for r in records]).astype(np.float64)
    values, vectors = np.linalg.eigh(descriptors.T @ descriptors)
    basis = vectors[:, ::-1][:, :DIRECTIONS]
    basis *= np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(DIRECTIONS)])
    print(f"{len(descriptors)} descriptors: {values[::-1][:DIRECTIONS].sum() / values.sum():.3f} of their squares")
    if arguments.output:
        np.save(arguments.output, basis.astype("<f4"))


if __name__ == "__main__":
    main()
