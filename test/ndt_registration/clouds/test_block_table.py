# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from ndt_registration.clouds.block_table import (
    MAX_CELLS_PER_AXIS,
    block_table,
    brick_key,
    brick_of,
    find_block,
    place_in_brick,
    with_room,
)


def test_blocks_are_found_after_the_table_has_grown(rng: np.random.Generator) -> None:
    blocks = np.unique(rng.integers(-30, 30, (700, 3)), axis=0).tolist()
    blocks += [[-MAX_CELLS_PER_AXIS, 5, MAX_CELLS_PER_AXIS], [MAX_CELLS_PER_AXIS, -MAX_CELLS_PER_AXIS, 0]]
    table = block_table(2)
    for row, block in enumerate(blocks):
        table = with_room(table, 1)
        brick = brick_of(table, brick_key(*block))
        assert table.rows[brick, place_in_brick(*block)] == -1
        table.rows[brick, place_in_brick(*block)] = row
    assert [find_block(table, *block) for block in blocks] == list(range(len(blocks)))
    assert len(np.unique(table.rows[: table.used[0]])) == len(blocks) + 1
    known = {tuple(block) for block in blocks}
    others = [block for block in rng.integers(-40, 40, (200, 3)).tolist() if tuple(block) not in known]
    assert {find_block(table, *block) for block in others} == {-1}
