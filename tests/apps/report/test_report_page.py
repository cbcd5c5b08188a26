"""The report in a browser, as a reader meets it: three widths, light and dark, printed, and fed with hostile texts."""

import re
from functools import partial

import numpy as np
import pandas as pd
import pytest

from kit.browser import browser_page, find_browser
from kit.folders import comparison, failed_only, made_up_row, made_up_steps, sweep, write_folder
from servobench.controllers.methods import METHODS
from servobench.harness.apps.figures.style import NARROW, TEXT, WIDE, method_styles
from servobench.harness.apps.report import page as report
from servobench.harness.batch import store
from servobench.harness.batch.results import ResultsFolder

pytestmark = pytest.mark.skipif(
    find_browser() is None, reason="no Chromium: the report is not opened in a browser"
)

WIDTHS = (390, 1024, 1600)
SMALLEST_TYPE = TEXT - 2.0  # [pt]
HOSTILE = "</script><script>window.pwned=1</script><img src=x onerror=window.pwned=1>\"'`{{7*7}}"
FOREIGN_WORDS = re.compile(r"\b(inf|None|NaN|nan|NaT|undefined|null)\b")
SHOWN_TEXT = "document.body.innerText"
# A closed list shows its choice shortened and the whole of it when it is open; Chromium 150 counts that as overflow.
TOO_WIDE = """Array.from(document.querySelectorAll('body *')).filter(e => e.getClientRects().length
  && (e.getBoundingClientRect().right > innerWidth + 0.5 || e.getBoundingClientRect().left < -0.5
      || (e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0 && e.tagName !== 'SELECT'
          && getComputedStyle(e).display !== 'inline')))
  .map(e => `${e.tagName} ${e.className} ${e.textContent.slice(0, 60)}`)"""

SHORT: str = "24"  # letters of a word that has to stay in one line
BROKEN_WORDS = """(() => { const found = []; const range = document.createRange();
  for (const cell of document.querySelectorAll('td span, th')) {
    const texts = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
    while (texts.nextNode()) for (const word of texts.currentNode.data.matchAll(/[^\\s_:+=/,.-]+/g)) {
      range.setStart(texts.currentNode, word.index);
      range.setEnd(texts.currentNode, word.index + word[0].length);
      const lines = new Set(Array.from(range.getClientRects(), r => Math.round(r.top)));
      if (word[0].length <= SHORT && lines.size > 1) found.push(word[0]);
    } }
  return found; })()""".replace("SHORT", SHORT)
UNLEVEL = """Array.from(document.querySelectorAll('table.many tbody tr:not(.detail)')).flatMap(row => {
  const lines = {};
  for (const cell of row.cells) if (cell.checkVisibility()) {
    (lines[Math.round(cell.getBoundingClientRect().top)] ??= []).push(cell.firstChild.getBoundingClientRect().top); }
  return Object.values(lines).filter(tops => Math.max(...tops) - Math.min(...tops) > 1.5); })"""
TEXTS_ON_EACH_OTHER = """(() => { const boxes = [], pen = CanvasRenderingContext2D.prototype, fill = pen.fillText;
  pen.fillText = function (text, x, y) { const width = this.measureText(text).width;
    boxes.push([text, x - { right: width, center: width / 2 , left: 0 }[this.textAlign], y, width]);
    fill.call(this, text, x, y); };
  dispatchEvent(new Event('resize'));
  pen.fillText = fill;
  const scales = boxes.filter(b => !['start', 'target'].includes(b[0]));
  return scales.length < 6 ? ['too few texts'] : scales.flatMap((a, i) => scales.slice(i + 1)
    .filter(b => a[1] < b[1] + b[3] && b[1] < a[1] + a[3] && Math.abs(a[2] - b[2]) < 12)
    .map(b => `${a[0]} on ${b[0]}`)); })()"""


def one_run(folder):
    return write_folder(folder, [made_up_row("a")], [made_up_steps("a")])


def long_names(folder):
    """Write a comparison whose names nobody foresaw, with both divisions of a method and runs that failed."""
    names = (
        "ukf_mfac",
        "ukf_mfac:published",
        "./controllers/a_folder/my_own_controller.py:MyVeryOwnController",
        "x" * 60,
    )
    rows = []
    for seed in range(2):
        for k, name in enumerate(names):
            values = {
                "controller": name,
                "seed": seed,
                "mismatch": "camera_rotation=30deg+links=5%+tool=20mm",
            }
            rows.append(made_up_row(f"{k}-{seed}", **values))
            lost = {
                "status": "crashed",
                "outcome": "crashed",
                "reason": "KeyError: 'x' " * 20,
                "settling_time_s": np.nan,
            }
            rows.append(
                made_up_row(f"{k}-lost-{seed}", task="a_task_with_a_long_name", **values, **lost)
            )
    return write_folder(folder, rows, [made_up_steps(row["run_id"]) for row in rows[::2]])


FOLDERS = {make.__name__: make for make in (sweep, failed_only, one_run, long_names)}
FOLDERS["comparison"] = partial(comparison, tasks=("exp1", "circle"))


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    root = tmp_path_factory.mktemp("pages")
    return {
        name: report.write_report(ResultsFolder(make(root / name)))
        for name, make in FOLDERS.items()
    }


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with browser_page(tmp_path_factory.mktemp("profile")) as page:
        yield page


def show(browser, path, width=1024, scheme="light"):
    browser.events.clear()
    browser.call(
        "Emulation.setDeviceMetricsOverride",
        width=width,
        height=900,
        deviceScaleFactor=1,
        mobile=False,
    )
    browser.call(
        "Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}]
    )
    browser.call("Page.navigate", url="about:blank")
    browser.open(path)
    browser.wait_for(
        "document.getElementById('count') && document.getElementById('count').textContent"
    )


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", FOLDERS)
def test_nothing_is_cut_or_broken_or_wider_than_the_window(browser, pages, name, width):
    show(browser, pages[name], width)
    assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert browser.evaluate(TOO_WIDE) == []
    assert browser.evaluate(BROKEN_WORDS) == []
    # The values of a card stand on one line
    assert width != WIDTHS[0] or browser.evaluate(UNLEVEL) == []
    assert browser.evaluate("Array.from(document.images).every(i => i.naturalWidth > 0)")
    assert browser.complaints() == []
    assert browser.requests() == []


@pytest.mark.parametrize("width", WIDTHS)
def test_the_hint_of_the_filter_is_not_cut(browser, pages, width):
    show(browser, pages["sweep"], width)
    hint = """(() => { const pen = document.createElement('canvas').getContext('2d'), style = getComputedStyle(filter);
      pen.font = style.font;
      return pen.measureText(filter.placeholder).width + 2 * parseFloat(style.paddingLeft); })()"""
    assert browser.evaluate(f"{hint} < filter.clientWidth")


@pytest.mark.parametrize("width", WIDTHS)
def test_no_scale_of_paths_in_space_covers_another(browser, pages, width):
    show(browser, pages["comparison"], width)
    assert browser.evaluate(TEXTS_ON_EACH_OTHER) == []
    for key in ("ArrowLeft", "ArrowUp", "ArrowUp"):
        event = f"new KeyboardEvent('keydown', {{key: '{key}'}})"
        browser.evaluate(
            f"for (let i = 0; i < 4; i += 1) document.getElementById('space-canvas').dispatchEvent({event})"
        )
        assert browser.evaluate(TEXTS_ON_EACH_OTHER) == []


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", ["comparison", "long_names", "sweep"])
def test_the_smallest_type_of_every_figure_can_be_read(browser, pages, name, width):
    show(browser, pages[name], width)
    drawn = (
        "Array.from(document.querySelectorAll('figure img'), i => [i.clientWidth, i.naturalWidth])"
    )
    layout = NARROW if width < 900 else WIDE
    shown = browser.evaluate(drawn)
    assert shown
    for across, pixels in shown:
        assert SMALLEST_TYPE / 72.0 * layout.scale * layout.density * across / pixels > 9.9


@pytest.mark.parametrize("name", FOLDERS)
def test_a_page_has_no_word_of_a_programming_language_and_no_link_that_leads_nowhere(
    browser, pages, name
):
    show(browser, pages[name])
    assert FOREIGN_WORDS.findall(browser.evaluate(SHOWN_TEXT)) == []
    data = re.search(
        r'<script type="application/json" id="data">(.*?)</script>', pages[name].read_text()
    )
    assert "NaN" not in data[1]
    assert "Infinity" not in data[1]

    dead = "Array.from(document.querySelectorAll('a')).filter(a => !document.getElementById(a.hash.slice(1))).length"
    assert browser.evaluate("document.querySelectorAll('nav a').length") >= 5
    assert browser.evaluate(dead) == 0
    assert browser.evaluate(
        "new Set(Array.from(document.querySelectorAll('[id]'), e => e.id)).size"
    ) == browser.evaluate("document.querySelectorAll('[id]').length")


def test_the_result_comes_first(browser, pages):
    show(browser, pages["comparison"], 390)
    assert browser.evaluate("document.querySelector('h1').getBoundingClientRect().top") < 150
    assert "settled or followed the curve" in browser.evaluate(
        "document.querySelector('h1').textContent"
    )


def test_contents_stay_beside_a_wide_page_and_fold_above_a_narrow_one(browser, pages):
    top = "document.querySelector('nav').getBoundingClientRect().top"
    link = "document.querySelector('nav a').checkVisibility()"
    show(browser, pages["comparison"], 1600)
    browser.evaluate("scrollTo(0, 1500)")
    assert browser.evaluate(f"{link} && {top} === 0 && scrollY > 1000")
    show(browser, pages["comparison"], 390)
    browser.evaluate("scrollTo(0, 1500)")
    assert browser.evaluate(f"!{link} && {top} === 0 && scrollY > 1000")
    browser.evaluate("document.querySelector('nav summary').click()")
    browser.wait_for(link)


def test_a_link_to_a_run_opens_its_curve_and_measures(browser, pages):
    show(browser, pages["comparison"])
    browser.evaluate("document.querySelector('#run-1 a').click()")
    browser.wait_for("document.querySelector('tr.detail svg path.own')")
    assert browser.evaluate("document.querySelectorAll('tr.detail').length") == 1
    text = browser.evaluate("document.querySelector('tr.detail').innerText")
    assert "kinematic-ukf_mfac-exp1-moderate-0" in text
    assert "settling time [s]" in text
    assert (
        browser.evaluate(
            "document.querySelector('tr.detail path.own').getAttribute('d').split('L').length"
        )
        > 30
    )
    browser.evaluate("location.hash = '#run-2'")
    browser.wait_for(
        "document.querySelector('tr.detail h4').textContent.includes('someone_elses-exp1')"
    )
    assert browser.complaints() == []


def test_the_address_of_a_run_can_be_sent_to_somebody(browser, pages):
    show(browser, pages["comparison"])
    browser.call("Page.navigate", url="about:blank")
    browser.call("Page.navigate", url=pages["comparison"].resolve().as_uri() + "#run-5")
    browser.wait_for("document.querySelector('tr.detail svg path.own')")
    opened = browser.evaluate(
        "Array.from(document.querySelectorAll('tr.detail h4'), h => h.textContent)"
    )
    assert opened == ["kinematic-someone_elses-circle-moderate-0"]


def test_a_run_without_steps_says_so(browser, pages):
    show(browser, pages["sweep"])
    browser.evaluate("document.querySelector('#run-3 a').click()")
    browser.wait_for("document.querySelector('tr.detail')")
    assert "steps of this run are not in the page" in browser.evaluate(
        "document.querySelector('tr.detail').innerText"
    )


def test_the_runs_can_be_filtered_sorted_and_shown_all(browser, pages):
    show(browser, pages["sweep"])
    rows = "Array.from(document.querySelectorAll('#run-table tbody tr')).filter(r => !r.hidden)"
    cells = f"{rows}.map(r => r.cells[CELL].textContent)"
    assert browser.evaluate(f"{rows}.length") == 25
    browser.evaluate("document.getElementById('more').click()")
    assert browser.evaluate(f"{rows}.length") == 54
    browser.evaluate("filter.value = 'UKF lost'; filter.dispatchEvent(new Event('input'))")
    assert browser.evaluate("document.getElementById('count').textContent") == "5 of 54 runs"
    browser.evaluate("filter.value = ''; filter.dispatchEvent(new Event('input'))")
    names = browser.evaluate(
        "Array.from(document.querySelectorAll('#run-table .heads th'), h => h.textContent)"
    )
    seed, outcome = names.index("seed"), names.index("outcome")
    for column, wanted in ((seed, ["0", "5"]), (outcome, ["feature_lost", "settled"])):
        for order in (wanted, wanted[::-1]):
            browser.evaluate(
                f"document.querySelectorAll('#run-table .heads button')[{column}].click()"
            )
            found = browser.evaluate(cells.replace("CELL", str(column)))
            assert [found[0], found[-1]] == order
    browser.evaluate(f"document.querySelectorAll('#run-table .heads button')[{outcome}].click()")
    assert browser.evaluate(cells.replace("CELL", "0"))[:3] == ["0", "1", "2"]


def test_an_infinite_time_sorts_behind_all_numbers(browser, tmp_path):
    times = (2.0, np.nan, 0.5)
    rows = [
        made_up_row(name, controller=name, settling_time_s=t)
        for name, t in zip("abc", times, strict=True)
    ]
    show(browser, report.write_report(ResultsFolder(write_folder(tmp_path / "out", rows, []))))
    heads = "Array.from(document.querySelectorAll('#moves-1 + .sheet .heads button'))"
    browser.evaluate(f"{heads}.find(b => b.textContent.startsWith('settling time')).click()")
    read = "Array.from(document.querySelectorAll('#moves-1 + .sheet tbody tr'), r => r.cells[0].textContent)"
    assert browser.evaluate(read) == ["c", "a", "b"]


def test_paths_turn_and_names_switch_them_off(browser, pages):
    show(browser, pages["comparison"])
    ink = (
        "(() => { const c = document.getElementById('space-canvas'); const d = c.getContext('2d')"
        ".getImageData(0, 0, c.width, c.height).data; let sum = 0; for (let i = 0; i < d.length; i += 4)"
        " sum = (sum * 31 + d[i] + d[i + 3]) % 1000000007; return sum; })()"
    )
    first = browser.evaluate(ink)
    assert first != 0
    browser.evaluate(
        "document.getElementById('space-canvas').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft'}))"
    )
    turned = browser.evaluate(ink)
    assert turned != first
    browser.evaluate("document.querySelector('#space-names input').click()")
    assert browser.evaluate(ink) != turned
    choice = "document.getElementById('space-choice')"
    assert browser.evaluate(f"{choice}.options.length") == 2
    browser.evaluate(f"{choice}.value = '1'; {choice}.dispatchEvent(new Event('change'))")
    assert browser.evaluate(ink) not in (first, turned)
    assert browser.complaints() == []


def test_dark_is_dark_and_light_on_it_can_be_read(browser, pages):
    look = (
        "[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]"
    )
    brightness = {}
    for scheme in ("light", "dark"):
        show(browser, pages["comparison"], scheme=scheme)
        brightness[scheme] = [
            sum(map(int, re.findall(r"\d+", colour))) for colour in browser.evaluate(look)
        ]
        inverted = browser.evaluate("getComputedStyle(document.querySelector('img.drawn')).filter")
        assert inverted.startswith("invert") == (scheme == "dark")
    assert brightness["light"][0] > 700 > 300 > brightness["light"][1]
    assert brightness["dark"][0] < 150 < 600 < brightness["dark"][1]


def test_every_colour_of_a_method_can_be_told_from_the_dark_page(browser, pages):
    show(browser, pages["comparison"], scheme="dark")
    colours = sorted({style.colour for style in method_styles(METHODS).values()})
    assert len(colours) > 8
    for colour in (*colours, "#ffffff"):
        draw = f"""(() => {{ const canvas = document.createElement('canvas'); const pen = canvas.getContext('2d');
          pen.filter = getComputedStyle(document.querySelector('img.drawn')).filter; pen.fillStyle = '{colour}';
          pen.fillRect(0, 0, 300, 150); return Array.from(pen.getImageData(9, 9, 1, 1).data.slice(0, 3)); }})()"""
        contrast = luminance(browser.evaluate(draw)) / luminance([0x1A, 0x1A, 0x1A])
        assert contrast < 1.02 if colour == "#ffffff" else contrast > 3.0, colour


def luminance(colour):
    """Return the relative luminance that WCAG 2 compares, with its offset."""
    linear = [
        c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in np.array(colour) / 255
    ]
    return np.dot([0.2126, 0.7152, 0.0722], linear) + 0.05


def test_on_paper_tables_are_tables_and_controls_are_gone(browser, pages):
    show(browser, pages["comparison"])
    browser.call("Emulation.setEmulatedMedia", media="print", features=[])
    browser.call(
        "Emulation.setDeviceMetricsOverride",
        width=695,
        height=1000,
        deviceScaleFactor=1,
        mobile=False,
    )
    assert (
        browser.evaluate("getComputedStyle(document.querySelector('table.many thead')).display")
        == "table-header-group"
    )
    assert browser.evaluate("getComputedStyle(document.querySelector('nav')).display") == "none"
    assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")
    browser.call("Emulation.setEmulatedMedia", media="", features=[])


def test_hostile_texts_stay_texts(browser, tmp_path):
    rows = [
        made_up_row(f"hostile-{k}", controller=name, task=HOSTILE, reason=HOSTILE,
                    status="completed" if k else HOSTILE, outcome=HOSTILE, plant=HOSTILE)
        for k, name in enumerate((HOSTILE, "b"))
    ]  # fmt: skip
    folder = write_folder(tmp_path / "out", rows, [made_up_steps(row["run_id"]) for row in rows])
    poisoned = {"created": HOSTILE, "python": HOSTILE, "git_commit": HOSTILE, "packages": {"servobench": HOSTILE},
                "configuration": {HOSTILE: {HOSTILE: HOSTILE}}}  # fmt: skip
    store.write_manifest(folder, poisoned)
    pd.DataFrame({HOSTILE: [HOSTILE]}).to_csv(folder / "claims.csv")
    path = report.write_report(ResultsFolder(folder))
    assert "<script>window" not in path.read_text()
    assert "<img src=x" not in path.read_text()
    show(browser, path)
    browser.evaluate("document.querySelector('#run-1 a').click()")
    browser.wait_for("document.querySelector('tr.detail')")
    assert browser.evaluate("window.pwned") is None
    assert browser.evaluate("document.querySelectorAll('img:not(.drawn)').length") == 0
    assert browser.evaluate("document.querySelectorAll('script').length") == 4
    assert HOSTILE in browser.evaluate("document.body.textContent")
    assert browser.complaints() == []


def test_the_policy_of_the_page_stops_a_script_that_is_not_its_own(browser, pages, tmp_path):
    path = tmp_path / "page.html"
    path.write_text(
        pages["one_run"].read_text().replace("</main>", "<script>window.pwned = 1</script></main>")
    )
    show(browser, path)
    assert browser.evaluate("window.pwned") is None
    assert any("Content Security Policy" in complaint for complaint in browser.complaints())
