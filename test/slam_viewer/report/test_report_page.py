# SPDX-License-Identifier: Apache-2.0
"""The report in a real browser: no width overflows, nothing is asked of another machine, the model is drawn."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from browser import Browser, find_chromium

CHROMIUM = find_chromium()
PLACE = (
    "(() => { const r = document.querySelector('iframe').getBoundingClientRect();"
    "return JSON.stringify([r.x, r.y, r.width, r.height].map(Math.round)); })()"
)


def show(browser: Browser, width: int, height: int) -> None:
    browser.call(
        "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500
    )


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt install chromium)")
def test_the_report_fits_every_screen_and_draws_the_model(out):
    assert CHROMIUM is not None
    with Browser(CHROMIUM) as browser:
        browser.open((out / "report.html").as_uri())
        browser.wait("document.readyState === 'complete'")
        for width in (400, 1000, 1600):
            show(browser, width, 900)
            assert browser.evaluate("document.documentElement.scrollWidth") <= width
        show(browser, 1000, 900)
        browser.evaluate("document.querySelector('iframe').scrollIntoView({block: 'center'})")
        for _ in range(30):
            browser.listen(2.0)
            x, y, w, h = json.loads(browser.evaluate(PLACE))
            image = cv2.imdecode(np.frombuffer(browser.screenshot(), dtype=np.uint8), cv2.IMREAD_COLOR)
            drawn = (image[y + 5 : y + h - 5, x + 5 : x + w - 5].min(axis=2) < 200).mean()
            if drawn > 0.1:
                break
        assert drawn > 0.1, "the model is not in its frame"
        assert not browser.errors
        assert not [r for r in browser.requests if re.match(r"(https?|wss?):", r)]


@pytest.mark.slow
def test_the_report_is_whole_and_small(out):
    html = (out / "report.html").read_text()
    assert len(html) < 10e6
    for words in (
        "Submaps",
        "What joining solves",
        "What the front end saw",
        "How it was made",
        "feature_extractor.mode",
    ):
        assert words in html
    assert html.count("data:image/jpeg;base64") == 6
