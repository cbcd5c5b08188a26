"""The page of `servobench play` in a real browser: it connects, shows its controls and complains of nothing."""

import contextlib

import pytest

from kit.browser import browser_page, find_browser
from kit.played import opened_page

pytest.importorskip("viser", reason="no viser: the extra play is not installed")
pytestmark = pytest.mark.skipif(
    find_browser() is None, reason="no Chromium: the page is not opened in a browser"
)
SHOWN = "document.body?.innerText?.includes('Knock the camera') && document.querySelector('canvas')"


@pytest.mark.slow
def test_the_page_connects_in_a_browser_wide_and_narrow_without_a_complaint(tmp_path):
    with (
        opened_page("calibrating_mfac", "ukf_mfac") as (page, port),
        contextlib.ExitStack() as stack,
    ):
        page.session.advance()
        for _ in range(10):
            page.show()
        browser = stack.enter_context(browser_page(tmp_path))
        for width, height in ((1600, 900), (390, 800)):
            browser.call(
                "Emulation.setDeviceMetricsOverride",
                width=width, height=height, deviceScaleFactor=1, mobile=width < 500,
            )  # fmt: skip
            if width > 500:
                browser.call("Page.navigate", url=f"http://127.0.0.1:{port}")
            browser.wait_for(SHOWN)
            browser.wait_for("document.documentElement.scrollWidth <= innerWidth")
        page.controls["beside"].value = "ukf_mfac"
        page.obey()
        for _ in range(10):
            page.show()
        browser.wait_for("document.body.innerText.includes('ukf_mfac')")
        assert browser.complaints() == []
        places = {url.split("/")[2] for url in browser.requests()}
        assert places == {f"127.0.0.1:{port}"}
