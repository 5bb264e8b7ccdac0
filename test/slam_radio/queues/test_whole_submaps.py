# SPDX-License-Identifier: Apache-2.0
"""Whole submaps on an agent's disk: they take what they may, lose nothing, and others' files there stay."""

from __future__ import annotations

import numpy as np
import pytest
from radio_world import SIZE

from slam_radio.packing.light_submap import pack, write
from slam_radio.queues.detail_store import DetailStore
from slam_radio.queues.whole_submaps import WholeSubmaps


def test_of_more_whole_submaps_than_may_lie_there_the_oldest_are_packed(tmp_path, make_submap):
    submaps = [make_submap(12, index=k) for k in range(4)]
    store = DetailStore(tmp_path / "one")
    store.keep((2, 0), submaps[0], pack(submaps[0], SIZE))
    store = DetailStore(tmp_path / "two", most_bytes=2.5 * store.whole.total)
    for k, submap in enumerate(submaps):
        store.keep((2, k), submap, pack(submap, SIZE))
    assert sorted(store.whole.sizes) == [(2, 2), (2, 3)]
    assert sorted(store.folder.sizes) == [(2, 0), (2, 1)]


def test_files_of_another_version_are_counted_stay_and_take_their_share_of_the_disk(tmp_path, make_submap):
    submaps = [make_submap(12, index=k) for k in range(4)]
    old = tmp_path / "whole"
    kept = WholeSubmaps(old)
    for k, submap in enumerate(submaps):
        kept.add((2, k), submap, pack(submap, SIZE))
    message = bytearray(pack(submaps[0], SIZE))
    message[2] += 1  # the version
    kept.add((2, 0), submaps[0], bytes(message))
    (old / "2-1.npz").rename(old / "2-9.npz")
    strangers = {name: (old / name).read_bytes() for name in ("2-0.npz", "2-9.npz")}
    size = kept.sizes[2, 2]
    store = DetailStore(tmp_path, most_bytes=3.5 * size)
    assert store.strangers == {old: 2}
    assert sorted(store.whole.sizes) == [(2, 2), (2, 3)]
    later = make_submap(12, index=4)
    store.keep((2, 4), later, pack(later, SIZE))
    assert sorted(store.whole.sizes) == [(2, 4)]
    store.folder.close()
    store = DetailStore(tmp_path, most_bytes=1.5 * size)
    store.keep((2, 4), later, pack(later, SIZE))
    assert not store.whole.sizes
    assert sorted(store.folder.sizes) == [(2, 2), (2, 3), (2, 4)]
    assert {name: (old / name).read_bytes() for name in strangers} == strangers
    store.keep((2, 0), submaps[0], pack(submaps[0], SIZE))
    assert sorted(store.whole.strangers) == [(2, 9)]


def test_a_file_that_turns_out_damaged_takes_its_share_of_the_disk_too(tmp_path, make_submap):
    submap = make_submap(12, index=0)
    store = DetailStore(tmp_path)
    store.keep((2, 0), submap, pack(submap, SIZE))
    (store.whole.path / "2-0.npz").write_bytes(b"PK damaged")
    assert not store.pack((2, 0))
    assert (store.damaged, store.whole.sizes, store.whole.total) == (1, {}, 10)


def test_a_whole_submap_on_disk_is_not_surer_and_says_the_same(tmp_path, make_submap):
    submap = make_submap(60)
    kept = WholeSubmaps(tmp_path)
    message = pack(submap, SIZE)
    kept.add((2, 3), submap, message)
    found, light, again = WholeSubmaps(tmp_path).read((2, 3))
    assert again == message
    assert write(light) == message
    L = np.linalg.inv(np.linalg.cholesky(submap.covariance))
    assert np.linalg.eigvalsh(L @ found.covariance @ L.T)[0] >= 1.0
    np.testing.assert_allclose(found.covariance, submap.covariance, rtol=1e-4, atol=1e-9)
    np.testing.assert_array_equal(found.descriptors, submap.descriptors)
    kept.add((2, 4), submap, message)
    with pytest.raises(ValueError, match="holds submap 2/3"):
        kept.read((2, 4))
