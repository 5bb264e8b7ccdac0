# SPDX-License-Identifier: Apache-2.0
"""Files of an earlier version of the format, which a program of before has left, are read and passed on."""

from __future__ import annotations

import struct
import zlib
from base64 import b85decode

import numpy as np
import pytest

from slam_radio.packing.key_poses import covering
from slam_radio.packing.light_submap import unpack
from slam_radio.packing.submap_details import key_of_details, with_details
from slam_radio.queues.inbox import Inbox
from slam_radio.wire.radio_messages import pack_submap

MESSAGE = b85decode(
    r"Q%nPEvMh1~Z*FA*00003000070KA}O0RR9108rN40RR910{{W}2mlBG0RRAiKh4ZcKF!R`z0J%_Jqp*OyqcMrK6y}_N%c@(MJC8=N-Dtqyeh"
    r"s|Ldw7$zVNu!y7EK_!!$Y4xGcaRLeNCrtxP}whC87F00000002MD%*;K_%uKxs*P}cN*CV`|nHfF-0QxcdIR<m+!wl(~NQ2%E9!U*AT-_2Qv"
    r"eMQFaoibSTb&~$;#krm)2FUNlFm$yrbj9VhPL;Lq9=Kk0{`6R1C}MWVxdhJ93p8eX0BmkFIKr!Lp_mgED>C%M>badC<$qVJ|`3b2+Y#oCb2m"
    r"r{@(lIMJpMB@+kP3YX|Vi9jf5WlSYWN@B"
)
"""Version 3, by the program of then: three of five landmarks and three poses of ``made(5, seed=3, dimension=8)``."""
DETAILS = b85decode(
    r"Q$zu9)>RM#Z*FA*000030001MvMh1}0QtZBi$MH-|9^5z;ttIbdtXo%a0Fgth{<E|LU?4f(0r!D3Qj<W=5CMY!_O2v4@Gk8%CU;2<EU{8+_;"
    r"p#H;4zG1UIM80T&s17(n5Dkiu$OE(W1+6cp~;o+9ZG25j_*K4hS|`Qdi1vO5x<X}$"
)
"""Version 1: the other two."""


@pytest.fixture
def submap(make_submap):
    return make_submap(5, seed=3, dimension=8)


def require_no_surer(found, true):
    L = np.linalg.inv(np.linalg.cholesky(found))
    assert np.linalg.eigvalsh(L @ true @ L.T)[-1] <= 1.0


def require_the_same(found, submap):
    rows = np.array([int(np.nonzero(submap.landmark_ids == i)[0][0]) for i in found.landmark_ids])
    unknowns = np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).ravel()])
    require_no_surer(found.covariance, submap.covariance[np.ix_(unknowns, unknowns)])
    np.testing.assert_allclose(found.landmarks, submap.landmarks[rows], atol=0.01)
    np.testing.assert_allclose(found.end_pose, submap.end_pose, atol=1e-6)
    assert np.einsum("nd,nd->n", found.descriptors, submap.descriptors[rows]).min() > 0.99
    assert [p.stamp_ns for p in found.path] == [p.stamp_ns for p in submap.path]
    for pose, true in zip(found.path, submap.path, strict=True):
        np.testing.assert_allclose(pose.T, true.T, atol=1e-6)
        require_no_surer(pose.covariance, true.covariance)


def test_a_submap_and_its_details_say_what_they_said(submap):
    assert MESSAGE[:3] == b"SL\x03"
    assert DETAILS[:3] == b"SD\x01"
    found = unpack(MESSAGE)
    require_the_same(found, submap)
    assert len(found.landmarks) == 3
    between = covering(0.25 * submap.covariance[:6, :6])  # the path is a quarter of the end's halfway
    assert (np.diag(found.path[1].covariance) < 1.5**2 * (1e-3 * between) ** 2).all()
    np.testing.assert_allclose(found.path[0].covariance, 1e-6 * found.covariance[:6, :6])
    np.testing.assert_array_equal(found.path[2].covariance, found.covariance[:6, :6])
    assert key_of_details(DETAILS) == (2, 3)
    found = with_details(MESSAGE, DETAILS)
    require_the_same(found, submap)
    assert len(found.landmarks) == 5
    np.testing.assert_array_equal(found.path[-1].covariance, found.covariance[:6, :6])


def test_files_of_before_in_an_inbox_are_passed_on_again_and_not_taken_twice(tmp_path, submap):
    (tmp_path / "details").mkdir()
    (tmp_path / "2-3.submap").write_bytes(MESSAGE)
    (tmp_path / "details" / "2-3.submap").write_bytes(DETAILS)
    inbox = Inbox("one", tmp_path)
    assert inbox.strangers == {}
    assert inbox.acknowledgement() == [(2, 3, 4)]
    found = inbox.release()
    assert [len(s.landmarks) for s in found] == [5]
    require_the_same(found[0], submap)
    assert inbox.take((2, 3), pack_submap(3, MESSAGE)) == []
    assert inbox.repeated == 1


def test_numbers_that_cannot_be_are_refused():
    end_gaussian = 1 + len("one") + struct.calcsize("<IIBqqHBbHHB6f")
    factors = end_gaussian + struct.calcsize("<21efq6f")
    for at, value, text in ((end_gaussian, np.inf, "not finite"), (factors + 2, -1.0, "without uncertainty")):
        forged = bytearray(MESSAGE[7:])
        struct.pack_into("<e", forged, at, value)
        with pytest.raises(ValueError, match=text):
            unpack(as_version_3(forged))


def as_version_3(rest):
    return struct.pack("<2sBI", b"SL", 3, zlib.crc32(rest)) + rest


def test_forged_ones_are_refused_or_have_finite_numbers(rng):
    refused = 0
    for _ in range(300):
        forged = bytearray(MESSAGE[7:])
        for at in rng.integers(len(forged), size=2):
            forged[at] = int(rng.integers(256))
        try:
            found = unpack(as_version_3(forged))
        except ValueError:
            refused += 1
        else:
            np.linalg.cholesky(found.covariance)
            for pose in found.path:
                np.linalg.cholesky(pose.covariance)
    assert 20 < refused < 300
