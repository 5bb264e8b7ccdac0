# SPDX-License-Identifier: Apache-2.0
"""The compiled parts of the surface against PyMCubes, SciPy and NumPy."""

from __future__ import annotations

import mcubes
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dense_mapping.reconstruction import surface_kernels as kernels
from dense_mapping.reconstruction.cube_triangles import triangle_table
from dense_mapping.reconstruction.row_keys import row_keys
from dense_mapping.reconstruction.surface import _MAX_SIGMA, voxel_statistics


@pytest.mark.parametrize("unknown", [0.0, 0.4])
def test_marching_cubes_cuts_as_pymcubes_does_and_leaves_out_what_is_not_known(rng, unknown):
    distance = gaussian_filter(rng.normal(size=(20, 20, 20)), 1.5).astype(np.float32)
    distance[rng.random(distance.shape) < unknown * (np.arange(20) > 9)] = np.nan
    vertices, triangles = mcubes.marching_cubes(distance, 0.0)
    whole = triangles[np.isfinite(vertices).all(axis=1)[triangles].all(axis=1)].astype(int)
    found, voxels, faces = kernels.march(distance, triangle_table())
    assert len(faces) == len(whole) > 100
    np.testing.assert_allclose(found[faces], vertices[whole][:, ::-1], atol=1e-12)
    assert np.abs(found[faces] - voxels[faces]).max() <= 0.5
    assert np.isfinite(distance[tuple(voxels[faces].reshape(-1, 3).T)]).all()


def test_means_are_those_of_the_statistics(rng):
    voxels = rng.uniform(0.1, 1.0, (3, 512, 4)).astype(np.float32) * np.float32([50, 3000, 9, 8])
    voxels[..., 3] = np.rint(voxels[..., 3])
    cube = np.full((16, 8, 8), np.nan, dtype=np.float32)
    corners = np.array([[8, 0, 0], [0, 0, 0]])
    limits, noise = (2, _MAX_SIGMA), (0.15, 0.002)
    kernels.fill_means(voxels, np.array([2, 0]), corners, limits, noise, cube)
    mean, _ = voxel_statistics(voxels[[0, 2]], 2)
    np.testing.assert_array_equal(cube, mean.reshape(16, 8, 8))
    assert 0.1 < np.isnan(cube).mean() < 0.9


def test_pieces_are_those_of_scipy(rng):
    faces = rng.integers(0, 500, (180, 3)).astype(np.int32)
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(500, 500))
    count, piece = connected_components(graph, directed=False)
    pairs = np.unique(np.stack([piece, kernels.pieces(faces, 500)]), axis=1)
    assert pairs.shape[1] == count > 20


@pytest.mark.parametrize("largest", [9, 1 << 40])
def test_keys_sort_as_their_rows_do(rng, largest):
    rows = rng.integers(-largest, largest, (3000, 4))[rng.integers(0, 3000, 5000)]
    first, kinds = (np.unique(keys, return_index=True, axis=0)[1] for keys in (rows, row_keys(rows)))
    np.testing.assert_array_equal(first, kinds)
    assert not len(row_keys(rows[:0]))
