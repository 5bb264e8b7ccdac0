# SPDX-License-Identifier: Apache-2.0
"""What is quoted of the thesis stands there, letter for letter, where its text is at hand."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slam_experiments import thesis
from slam_experiments.thesis import Claim

ROOT = Path(__file__).resolve().parents[2]
SEED = ROOT.parent / "shared" / "seed" / "000_f49c7e5b3e960886.txt"
CLAIMS = {name: claim for name, claim in vars(thesis).items() if isinstance(claim, Claim)}
PAGE = json.loads((ROOT / "docs" / "experiments.json").read_text())


def words(text: str) -> str:
    return " ".join(text.split())


@pytest.fixture(scope="module")
def seed() -> str:
    if not SEED.exists():
        pytest.skip("the thesis's text is not at hand")
    return words(SEED.read_text(encoding="utf-8"))


@pytest.mark.parametrize("claim", CLAIMS.values(), ids=CLAIMS)
def test_a_quote_stands_in_the_thesis(claim, seed):
    assert claim.quote in seed


def test_every_quote_of_the_page_stands_in_the_thesis(seed):
    quotes = [c["quote"] for entry in PAGE for c in entry["comparisons"] if c["quote"]]
    assert len(quotes) > 30
    assert not [quote for quote in quotes if quote not in seed]


def test_the_page_says_nothing_of_the_thesis_but_claims_and_what_it_lacks():
    known = {str(claim): claim.quote for claim in CLAIMS.values()}
    known |= {thesis.ABSENT: "", thesis.CH11_ABSENT: "", "": ""}
    for entry in PAGE:
        for c in entry["comparisons"]:
            assert known.get(c["thesis"]) == c["quote"], f"{entry['name']}: {c['quantity']}"
