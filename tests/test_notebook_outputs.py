"""The comparison of stored outputs with a run: what it lets pass, and that it fails where a reader would notice."""

import copy

import pytest
from test_documents import script

check = script("notebooks/check.py")


def cell(*texts, stderr="", picture=False):
    outputs = [{"output_type": "stream", "name": "stdout", "text": [text]} for text in texts]
    outputs += [{"output_type": "stream", "name": "stderr", "text": [stderr]}] if stderr else []
    shown = {"image/png": "iVBORw0KGgo=", "text/plain": ["<Figure size 640x480>"]}
    outputs += [{"output_type": "display_data", "data": shown, "metadata": {}}] if picture else []
    return {"cell_type": "code", "source": [], "outputs": outputs}


def html(text):
    return {"outputs": [{"output_type": "execute_result", "data": {"text/html": [text], "text/plain": ["<Page>"]}}]}


def found(stored, run):
    return list(check.differences({"cells": [{"source": ["text"]}, stored]}, {"cells": [{"source": ["text"]}, run]}))


@pytest.mark.parametrize(
    ("stored", "run"),
    [
        (cell("rms 0.2273 mm/s²\n", "rank 12\n"), cell("rms 0.2281 mm/s²\nrank 12\n")),
        (cell("p = 3.7·10⁻⁹"), cell("p = 3.65·10⁻⁹")),
        (cell("p = 9e-46, left over 2.2e-15"), cell("p = 1.8·10⁻⁴⁵, left over −1.1e-15")),
        (cell("± 0.4°, 0.00022"), cell("± 0.5°, 0.00023")),
        (cell("[ 0. -0.3 1. ]"), cell("[-0.1 -0.3 1. ]")),
        (cell("a recording\nat rest\n──────\n"), cell("a recording at\nrest\n────────\n")),
        (cell("text", stderr="done in 3 s"), cell("text", stderr="done in 4 s")),
        (cell("text", picture=True), cell("text", picture=True)),
        (html("<p>rms <b>4.86</b> m/s² &lt; 5</p>"), html("<svg><path d='M 1'/></svg><p>rms 4.87 m/s² &lt; 5</p>")),
    ],
)
def test_what_another_machine_may_print_passes(stored, run):
    assert found(stored, run) == []


@pytest.mark.parametrize(
    ("stored", "run"),
    [
        (cell("rms 0.2273 mm/s²"), cell("rms 0.2473 mm/s²")),
        (cell("rms 0.2273 mm/s²"), cell("rms 0.2273 m/s²")),
        (cell("24 of 25 recordings"), cell("25 of 25 recordings")),
        (cell("unit-6174"), cell("unit-6175")),
        (cell("[1. 2.]"), cell("[1. 3.]")),
        (cell("100 poses"), cell("103 poses")),
        (cell("bias 0.2273"), cell("bias −0.2273")),
        (cell("p = 3.7·10⁻⁹"), cell("p = 3.7·10⁻⁸")),
        (cell("rms 1.0"), cell("rms nan")),
        (cell("effect a"), cell("effect a or b")),
        (cell("effect a or b"), cell("effect a")),
        (cell("text", picture=True), cell("text")),
        (cell("text"), cell("text", picture=True)),
        (html("<p>rms 4.86</p>"), html("<p>rms 5.86</p>")),
    ],
)
def test_a_change_that_a_reader_sees_fails(stored, run):
    assert len(found(stored, run)) == 1


def test_a_difference_names_the_cell_and_the_two_lines():
    (sentence,) = found(cell("first\n", "  rms 1.0 m/s²\n", "rms 2.0\n"), cell("first\nrms 1.5 m/s²\nrms 3.0\n"))
    assert sentence == "cell 1:\n  stored: rms 1.0 m/s²\n  run:    rms 1.5 m/s²"
    (sentence,) = found(cell("first\n"), cell("first\nsecond\n"))
    assert sentence == "cell 1:\n  stored: (nothing)\n  run:    second"


def test_a_notebook_runs_is_compared_and_written(tmp_path, monkeypatch, capsys):
    nbformat, _ = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    source = "import sys\nprint('of', 1 + 1)\nprint('working', file=sys.stderr)\nprint(f'{folder}/log.csv')"
    monkeypatch.setenv("JAXIMU_DATA", str(tmp_path))
    notebook = nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_code_cell(f"folder = {str(tmp_path)!r}\n{source}", outputs=[])],
        metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}},
    )
    path = tmp_path / "1_one.ipynb"
    nbformat.write(notebook, path)
    before = path.read_text()

    def main(*arguments):
        monkeypatch.setattr("sys.argv", ["check.py", *arguments, str(path)])
        with pytest.raises(SystemExit) as stop:
            check.main()
        return bool(stop.value.code), capsys.readouterr().out

    failed, text = main()
    assert failed and path.read_text() == before
    assert text == "1_one.ipynb: 1 cell differs\ncell 0:\n  stored: (nothing)\n  run:    of 2\n"
    assert main("--write")[0] is False
    stored = nbformat.read(path, 4)
    assert [output["text"] for output in stored.cells[0].outputs] == ["of 2\nlog.csv\n"]
    assert main() == (False, "1_one.ipynb: 0 cells differ\n")
    changed = copy.deepcopy(stored)
    changed.cells[0].outputs[0]["text"] = "of 3\nlog.csv\n"
    nbformat.write(changed, path)
    assert main() == (True, "1_one.ipynb: 1 cell differs\ncell 0:\n  stored: of 3\n  run:    of 2\n")
    changed.cells[0].source = "1 / 0"
    nbformat.write(changed, path)
    failed, text = main("--write")
    assert failed and "ZeroDivisionError" in text and "1 / 0" in path.read_text()
