# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
import time

from sjsam_node.joiner_stage import JoinerStage


def test_what_is_asked_for_goes_before_submaps_that_wait_and_their_number_is_told() -> None:
    joiner, gate, done = JoinerStage(), threading.Event(), []
    joiner.join(gate.wait)
    joins = [joiner.join(lambda k=k: done.append(k)) for k in range(3)]
    question = joiner.ask(lambda: done.append("asked"))
    assert joiner.waiting == joiner.waiting_at_most == joiner.received == 4
    gate.set()
    question.result(5.0)
    joins[-1].result(5.0)
    joiner.close()
    assert done == ["asked", 0, 1, 2]
    assert (joiner.waiting, joiner.waiting_at_most) == (0, 4)


def test_a_stopped_joiner_leaves_what_waits_undone() -> None:
    joiner, begun, gate, done = JoinerStage(), threading.Event(), threading.Event(), []
    joiner.join(lambda: begun.set() or (gate.wait() and done.append("at hand")))
    waiting = joiner.join(lambda: done.append("waiting"))
    assert begun.wait(5.0)
    stopping = threading.Thread(target=joiner.stop)
    stopping.start()
    while joiner._tasks.qsize() < 2:
        time.sleep(0.001)
    gate.set()
    stopping.join(5.0)
    assert done == ["at hand"]
    assert not waiting.done()
