"""A page drawn three ways: as text, as an HTML file and for a notebook; with names and texts of any kind."""

import html
import json
import re
import shutil
import subprocess

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaximu.ground.page import Code, Items, Matrices, Page, Picture, Section, Statement, Table
from jaximu.report.figures import dressed, new_figure
from jaximu.report.html import encoded, fragment, write_report
from jaximu.report.terminal import text

LONG = "an_accelerometer_whose_name_has_rather_more_than_a_hundred_letters_" * 2
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
# Of each text: how far it reaches over the window, and its contrast with what lies behind it (WCAG 2.1).
MEASURE = """
const light = c => c.map(v => (v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
  .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
const numbers = text => text.match(/[\\d.]+/g).map(Number);
const behind = e => { for (; e; e = e.parentElement) { const c = numbers(getComputedStyle(e).backgroundColor);
  if (c.length < 4 || c[3] > 0) return c.slice(0, 3); } return [255, 255, 255]; };
let worst = 99, where = "";
for (const e of document.querySelectorAll("body *:not(svg):not(svg *):not(script):not(style):not(button)")) {
  if (![...e.childNodes].some(n => n.nodeType === 3 && n.data.trim())) continue;
  const [a, b] = [numbers(getComputedStyle(e).color).slice(0, 3), behind(e)].map(light);
  const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  if (ratio < worst) [worst, where] = [ratio, e.textContent.slice(0, 40)];
}
document.title = JSON.stringify({over: document.documentElement.scrollWidth - innerWidth, worst, where});
"""


def figure():
    drawn = new_figure(2.0)
    axes = drawn.subplots()
    axes.plot([0, 1], [0, 1])
    dressed(axes, "a line")
    return drawn


def page(words: str = LONG) -> Page:
    """A page with every kind of part, each with these words."""
    table = Table(("parameter", "± 95 %", words), [(words, "1.2 ± 0.3 mm/s²", words)] * 4, words, [1], brief=2)
    parts = [
        words,
        Statement(words, words, True),
        Statement("About", words),
        table,
        Picture("line", figure, words, words),
        Items([words, "`jaximu info LOG`"]),
        Code(words),
        Matrices(["K =", [[words, "0"], ["0", "1"]]]),
        Section(words, [Table((), [("name", words)])], 3),
    ]
    return Page(words, (words,), "1.2 ± 0.3 mm/s²", words, parts, lambda: [Section("More", [words])], [words], words)


def test_text_keeps_to_its_width_and_shows_what_the_first_screen_has():
    lines = str(page()).splitlines()
    assert max(len(line) for line in lines if line != f"  {LONG}") <= 100  # what is to be copied is not folded
    assert "! " in str(page("short")) and "… and 2 more in the report" in lines and "More" not in lines


@given(st.text(max_size=60))
@settings(max_examples=30, deadline=None)
def test_whatever_the_words_are_they_are_text(words):
    """No markup of theirs reaches a renderer; HTML has the tags of a page without them."""
    assert max(map(len, text(Statement("a", words)).splitlines()), default=0) <= 100
    tags = [re.findall(r"<[a-z/]+", fragment(part)) for part in (Statement(words, words), Statement("a", "a"))]
    plain = [tag for tag in tags[0] if tag not in ("<code", "</code", "<br")]
    assert plain == [tag for tag in tags[1] if tag != "<br"]


def test_a_notebook_has_the_first_screen():
    shown = page("some words")._repr_html_()
    assert shown.count("<table") == 3 and "some words" in shown and "svg" not in shown and "More" not in shown


def test_a_file_has_everything():
    content, pictures = encoded(page("some words"))
    assert list(pictures) == ["line.png"] and b'id="more"' in content and content.count(b"<svg") == 1


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize("scheme", [0, 1], ids=["dark", "light"])
@pytest.mark.parametrize("width", [400, 1280])
def test_in_a_browser_nothing_is_wider_than_the_window_and_all_can_be_read(tmp_path, width, scheme):
    path = write_report(page(), tmp_path)
    content = re.sub(r"<meta http-equiv[^>]*>", "", path.read_text(encoding="utf-8"))
    path.write_text(content.replace("</body>", f"<script>{MEASURE}</script></body>"), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},2000", "--dump-dom"]
    line = [str(CHROMIUM), *options, f"--blink-settings=preferredColorScheme={scheme}", path.as_uri()]
    shown = subprocess.run(line, capture_output=True, text=True, timeout=120, check=True).stdout
    match = re.search(r"<title>(.*?)</title>", shown)
    assert match is not None
    measured = json.loads(html.unescape(match[1]))
    assert measured["over"] <= 0 and measured["worst"] >= 4.5, measured
