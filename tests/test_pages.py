"""Pages in a browser: on a phone and on a desk, light and dark. Needs Chromium (`apt-get install chromium`)."""

import re
import shutil
import subprocess

import pytest

from jaxpanda.report import Figure, Listing, Section, Table, to_html

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
PROBE = """<script>
const wide = element => element.getBoundingClientRect().right;
const parts = "p, h1, h2, nav, figcaption, caption, summary, .table, figure > div";
const clear = [...document.querySelectorAll(parts)];
const told = [innerWidth, document.documentElement.scrollWidth, Math.max(...clear.map(wide)),
    performance.getEntriesByType("resource").length, getComputedStyle(document.body).backgroundColor].join(";");
parent.postMessage(told, "*");
</script>"""
SCREEN = """<style>:root { color-scheme: light dark; } iframe { border: 0; }</style><body>
<script>onmessage = message => { document.body.dataset.told = message.data; };</script>
<iframe src="%s" width="%d" height="800"></iframe></body>"""
"""A screen narrower than a window of Chromium's may be."""
DARK = "--blink-settings=preferredColorScheme=0"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """With all that a page may hold, wider than a phone, and what tells how a browser has it."""

    def draw(canvas):
        canvas.subplots(1, 1).plot([0, 1], [0, 1], label="a curve")

    columns = ["effect", *(f"joint {j + 1}" for j in range(7))]
    rows = [["a name of several words", *["-1.234567 ± 0.012"] * 7]] * 3
    caption = (
        "A caption of a table that is longer than a phone is wide, so that it has to be broken somewhere"
    )
    shades = [[None, *[0.5] * 7]] * 3
    sections = [
        Section("Verdict", ["A sentence.", caption], [Table(columns, rows, caption)], tone="bad"),
        Section("Shaded", tables=[Table(columns, rows, caption, shades, more="better", less="worse")]),
        Section("Folded", tables=[Table(columns, rows, caption, folded=True)]),
        Section("Drawn", figures=[Figure(draw, caption, (inches, 3.0)) for inches in (4.5, 7.6, 10.0)]),
        Section("Listed", listings=[Listing([("add", "+ " + 40 * "long "), ("", "same")], "corrected.xml")]),
    ]
    path = tmp_path_factory.mktemp("page") / "report.html"
    to_html("a page", sections, path)
    path.write_text(path.read_text().replace("</body>", PROBE + "</body>"))
    return path


@pytest.mark.parametrize("width", [390, 1200])
@pytest.mark.parametrize("dark", [False, True])
def test_a_page_fits_the_screen_and_asks_nobody(page, tmp_path, width, dark):
    screen = tmp_path / "screen.html"
    screen.write_text(SCREEN % (page.as_uri(), width))
    options = ["--window-size=1400,900", f"--user-data-dir={tmp_path / 'user'}", *([DARK] if dark else [])]
    alone = "no-first-run disable-background-networking disable-component-update disable-sync"
    how = ["--headless", "--no-sandbox", "--disable-gpu", *(f"--{option}" for option in alone.split())]
    command = [CHROMIUM, *how, *options, "--dump-dom"]
    done = subprocess.run(
        [*command, screen.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    (told,) = re.findall(r'data-told="([^"]*)"', done.stdout)
    inner, scrolled, farthest, asked, background = told.split(";")
    assert int(inner) == width
    assert int(scrolled) <= width
    assert float(farthest) <= width
    assert int(asked) == 0
    assert background == ("rgb(20, 26, 32)" if dark else "rgb(255, 255, 255)")
