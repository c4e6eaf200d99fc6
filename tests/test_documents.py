"""What the pages say: figures are those of the last runs, links lead somewhere, counts are the catalogue's."""

import importlib.util
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from jaximu._version import __version__
from jaximu.cli.app import main
from jaximu.model.effects import CATALOGUE

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "benchmarks" / "README.md",
    *sorted((ROOT / "notebooks").glob("*.md")),
]


def script(path):
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_phone_is_the_one_that_the_script_simulates(tmp_path, capsys):
    assert main(["demo", "--data", str(tmp_path)]) == 0
    for name, text in script("notebooks/phone.py").files().items():
        kept = (tmp_path / name).read_text()
        assert kept.partition("\n")[0] == text.partition("\n")[0]
        made, written = (np.loadtxt(each.splitlines()[1:], delimiter=",") for each in (text, kept))
        np.testing.assert_allclose(written, made, atol=2e-6)
    assert main(["info", str(tmp_path / "Accelerometer.csv")]) == 0
    assert f"--gyro-log {tmp_path / 'Gyroscope.csv'}" in capsys.readouterr().out
    assert main(["diagnose", str(tmp_path / "Accelerometer.csv")]) == 0  # the other file lies beside it
    out, told = capsys.readouterr()
    assert f"{tmp_path / 'Gyroscope.csv'} is read" in told
    assert "accel.asymmetry" in out and " ".join(out.split()).count("One clock is assumed") == 1


def test_dead_links_of_the_site_are_found(tmp_path, monkeypatch):
    module = script("notebooks/site.py")
    monkeypatch.setattr(module, "SITE", tmp_path)
    (tmp_path / "a.html").write_text('<a href="b.html#x"></a> <a href="b.html#y"></a> <img src="c.png">')
    (tmp_path / "b.html").write_text('<p id="x"></p> <a href="#x"></a> <a href="https://example.org/"></a>')
    assert module.broken_links() == ["a.html: b.html#y", "a.html: c.png"]


def test_figures_are_those_of_the_results():
    for path, text in script("benchmarks/readme.py").pages().items():
        assert path.read_text(encoding="utf-8") == text, (
            f"run `python benchmarks/readme.py`: {path.name} is not up to date"
        )


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert target.startswith("https:") or (page.parent / target).exists(), target


def test_the_readme_is_one_that_is_read_to_its_end():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_the_catalogue_is_counted_right():
    causes = sum(effect.cause for effect in CATALOGUE.values())
    guide = (ROOT / "notebooks" / "commands.md").read_text(encoding="utf-8")
    assert f"the catalogue: {causes} causes" in guide
    assert f"and {causes - 1} other causes" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_section_on_diagnose_explains_the_options_that_change_its_verdict():
    guide = (ROOT / "notebooks" / "commands.md").read_text(encoding="utf-8")
    section = guide.partition("\n## Diagnose\n")[2].partition("\n## ")[0]
    for option in ("--static", "--heldout", "--latitude", "--by", "--repair"):
        assert f"`{option}" in section


def test_the_citation_names_this_version():
    """And the title, licence and authors that the package states."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    stated = dict(re.findall(r"(?m)^(?:  - )?(\w[\w-]*): (\S.*)$", text))
    assert {key: stated[key] for key in ("title", "version", "license", "name")} == {
        "title": project["name"],
        "version": __version__,
        "license": project["license"],
        "name": project["authors"][0]["name"],
    }
    assert re.findall(r"(?m)^  - (\w[\w ]*)$", text) == project["keywords"]


def test_the_conda_recipe_asks_for_what_the_package_does():
    """Under conda's name for matplotlib without its windows."""
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project, text = whole["project"], (ROOT / ".ci" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    assert re.search(r'(?m)^  version: "(.+)"$', text)[1] == __version__
    assert ">=" + re.search(r'(?m)^  python_min: "(.+)"$', text)[1] == project["requires-python"]
    assert f'summary: "{project["description"]}"' in text and f"license: {project['license']}" in text
    (command,) = re.findall(r"- (\w+ = [\w.:]+)", text)
    assert dict([command.split(" = ")]) == project["scripts"]
    host, run = (
        re.findall(r"(?m)^    - (.+)$", part)
        for part in re.search(r"(?s)\n  host:\n(.+?)\n  run:\n(.+?)\n\n", text).groups()
    )
    stated = {line.replace(" >=", ">=").replace("matplotlib-base", "matplotlib") for line in run}
    assert stated == {*project["dependencies"], "python>=${{ python_min }}"}
    assert {line.replace(" >=", ">=") for line in host} >= set(whole["build-system"]["requires"])
