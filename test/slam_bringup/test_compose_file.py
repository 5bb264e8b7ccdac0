# SPDX-License-Identifier: Apache-2.0
"""The compose file of ``docs/scale.md``: Dask's own commands take its options, and its services fit each other."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]


def test_the_services_start_dask_with_options_that_it_has():
    pytest.importorskip("distributed")
    from distributed.cli.dask_scheduler import main as scheduler
    from distributed.cli.dask_worker import main as worker

    services = yaml.safe_load((ROOT / "docs" / "compose.yaml").read_text())["services"]
    assert set(services) == {"scheduler", "worker"}
    for name, command in (("scheduler", scheduler), ("worker", worker)):
        program, kind, *words = services[name]["entrypoint"]
        assert program.endswith("/.venv/bin/dask")
        assert kind == name
        assert all(isinstance(word, str) for word in words)  # a number that YAML reads is no argument
        assert command.make_context(name, list(words), resilient_parsing=False).params
    address = next(word for word in services["worker"]["entrypoint"] if word.startswith("tcp://"))
    host, port = address.removeprefix("tcp://").split(":")
    assert host in services["worker"]["depends_on"]
    assert port in services[host]["entrypoint"]
    assert all(published.startswith("127.0.0.1:") for published in services["scheduler"]["ports"])
    assert services["worker"]["image"] == services["scheduler"]["image"]
