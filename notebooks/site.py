"""Build the documents as a site: `python notebooks/site.py`; the pages are in build/site, index.html first.

Pages come from the README, the Markdown and notebooks beside this script, the effects' catalogue, docstrings and the
benchmarks. Warnings are errors, and every link is followed.
"""

import base64
import inspect
import io
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import matplotlib.pyplot as plt

from jaximu.model.effects import CATALOGUE

HERE = Path(__file__).parent
ROOT = HERE.parent
PAGES, SITE = ROOT / "build" / "pages", ROOT / "build" / "site"
MODULES = (
    "jaximu",
    "jaximu.model",
    "jaximu.model.sensor",
    "jaximu.recordings.recording",
    "jaximu.calibration",
    "jaximu.diagnosis",
    "jaximu.model.effects",
    "jaximu.noise",
    "jaximu.noise.identification",
    "jaximu.simulation.protocols",
    "jaximu.simulation",
    "jaximu.planning",
    "jaximu.fleets",
    "jaximu.model.conventions",
    "jaximu.estimation.fitting",
    "jaximu.data.motion",
    "jaximu.data.sightings",
    "jaximu.data.gravity_norm",
    "jaximu.data.gravity_direction",
    "jaximu.data.poses",
    "jaximu.data.station_error",
    "jaximu.data.poses_covariance",
    "jaximu.estimation.uncertainty",
    "jaximu.diagnosis.evidence",
    "jaximu.estimation.leave_out",
    "jaximu.mistakes",
    "jaximu.planning.separation",
    "jaximu.navigation.estimator_noise",
    "jaximu.report.export.noise",
)
MOVED = {  # where a link of the repository leads on the site
    r"(?:\.\./)?README\.md": "index.md", r"(?:\.\./)?benchmarks/results/(\w+)\.md": r"results/\1.md",
    r"(?:\.\./)?benchmarks/README\.md": "benchmarks.md", r"(?:\.\./)?benchmarks/results/(\w+\.png)": r"results/\1",
    r"(?:\.\./)?(CHANGELOG|CONTRIBUTING)\.md": r"\1.md", r"(?:notebooks/)?(\w+)\.(?:ipynb|md)": r"\1.md",
}  # fmt: skip


def linked(text: str) -> str:
    """Return Markdown whose links lead where the pages are on the site."""

    def moved(found: re.Match[str]) -> str:
        target, mark, place = found[1].partition("#")
        for pattern, new in MOVED.items():
            if match := re.fullmatch(pattern, target):
                return f"]({match.expand(new)}{mark}{place})"
        return found[0]

    return re.sub(r"\]\(([^)\s:]+)\)", moved, text)


def notebook(path: Path) -> str:
    """Return a notebook as Markdown; its pictures are written beside the page."""
    parts = []
    for place, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(linked(source))
            continue
        if source.startswith("%env"):
            continue
        language, source = ("sh", source.removeprefix("%%sh\n")) if source.startswith("%%sh") else ("python", source)
        parts.append(f"```{language}\n{source}\n```")
        printed = ""
        for number, output in enumerate(cell["outputs"]):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}-{place}-{number}.png"
                (PAGES / name).write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![Output of the cell above]({name})")
            elif "text/html" in data:
                parts.append("".join(data["text/html"]))
            else:
                printed += "".join(output.get("text", data.get("text/plain", "")))
        if printed:
            parts.append(f"```text\n{printed.rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


def entrance() -> str:
    """Return the README with "Which command" first."""
    title, *sections = re.split(r"(?m)^(?=## )", (ROOT / "README.md").read_text(encoding="utf-8"))
    which = next(each for each in sections if each.startswith("## Which command"))
    return linked("".join([title.partition("![")[0], which, *(each for each in sections if each is not which)]))


def cut_atlas() -> set[str]:
    """Write the picture of each effect, cut from those of notebook 2, and return which effects have one."""
    cut = set()
    for cell in json.loads((HERE / "2_atlas_of_effects.ipynb").read_text(encoding="utf-8"))["cells"]:
        for output in cell.get("outputs", []):
            for name, (left, top, right, bottom) in output.get("metadata", {}).get("effects", {}).items():
                picture = plt.imread(io.BytesIO(base64.b64decode(output["data"]["image/png"])))
                plt.imsave(PAGES / f"{name}.png", picture[max(top - 4, 0) : bottom + 4, max(left - 4, 0) : right + 4])
                cut.add(name)
    return cut


def catalogue() -> str:
    """Return a section for each effect, with its picture where notebook 2 draws one."""
    drawn = cut_atlas()
    parts = [
        "# The catalogue of effects",
        "Every term that a sensor or a set-up can have beyond gain and bias, as the code states it. A picture shows "
        "what the effect leaves over once gain and bias are fitted; [the atlas](2_atlas_of_effects.md) explains how it "
        "is drawn. Those of a magnetometer are in [nine axes](8_nine_axes.md).",
    ]
    for name, kind in CATALOGUE.items():
        parts.append(f"## {kind.title[:1].upper()}{kind.title[1:]} {{#{name}}}\n\n`{kind.formula}`")
        if name in drawn:
            parts.append(f"![What {kind.english} leaves over]({name}.png)")
        parts.append(inspect.cleandoc(kind.__doc__ or ""))
        alike = ", ".join(f"[{CATALOGUE[each].english}](#{each})" for each in kind.look_alikes) or "nothing"
        parts.append(f"Excited by {kind.excited_by}. Easily taken for {alike}. Source: {kind.source}.")
    return "\n\n".join(parts) + "\n"


def write_pages() -> None:
    shutil.rmtree(ROOT / "build", ignore_errors=True)
    (PAGES / "results").mkdir(parents=True)
    texts = {path.stem: linked(path.read_text(encoding="utf-8")) for path in HERE.glob("*.md")}
    texts |= {path.stem: notebook(path) for path in HERE.glob("*.ipynb")}
    for name in ("CHANGELOG", "CONTRIBUTING"):
        texts[name] = linked((ROOT / f"{name}.md").read_text(encoding="utf-8"))
    texts |= {"index": entrance(), "effects": catalogue()}
    texts["benchmarks"] = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8").replace("(../", "(")
    texts["api"] = "# Python\n\n" + "\n\n".join(f"## {name}\n\n::: {name}" for name in MODULES) + "\n"
    for name, text in texts.items():
        (PAGES / f"{name}.md").write_text(text, encoding="utf-8")
    for path in (ROOT / "benchmarks" / "results").glob("*.[mp][dn]*"):
        shutil.copy(path, PAGES / "results")


class Page(HTMLParser):
    """The links and the anchors of a page."""

    def __init__(self, path: Path):
        super().__init__()
        self.links: list[str] = []
        self.places: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value for name, value in attrs if name in ("href", "src") and value]
        self.places |= {value for name, value in attrs if name in ("id", "name") and value}


def broken_links() -> list[str]:
    """Return the links inside the site that lead nowhere."""
    pages = {path.resolve(): Page(path) for path in SITE.rglob("*.html") if path.name != "404.html"}
    broken = []
    for path, page in pages.items():
        for link in page.links:
            target = urlsplit(link)
            if target.scheme or target.netloc:
                continue
            there = (path.parent / unquote(target.path)).resolve() if target.path else path
            there = there / "index.html" if there.is_dir() else there
            known = there in pages and unquote(target.fragment) not in pages[there].places | {""}
            if not there.exists() or known:
                broken.append(f"{path.relative_to(SITE.resolve())}: {link}")
    return broken


if __name__ == "__main__":
    write_pages()
    shutil.copy(HERE / "zensical.toml", ROOT / "build")
    command = [str(Path(sys.executable).with_name("zensical")), "build", "--strict"]
    if subprocess.run(command, check=False, cwd=ROOT / "build").returncode:
        raise SystemExit("the site was not built.")
    if broken := broken_links():
        raise SystemExit("links that lead nowhere:\n" + "\n".join(sorted(set(broken))))
    print(f"{SITE.relative_to(ROOT)}/index.html: {len(list(SITE.rglob('*.html')))} pages")
