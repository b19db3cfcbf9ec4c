"""Pages of results say of which commit they are, on which machine and by which command they were made, and when they are older than the code."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from perch_eval import revision
from perch_eval.evaluation import front_page, front_pictures

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
PAGES = sorted(RESULTS.rglob("*.md"))
NOW = revision.digest()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(RESULTS)))
def test_a_page_says_of_which_code_it_is_and_how_it_was_made(page):
    text = page.read_text()
    assert re.match(r"# .+\n\n> \*\*Of commits? [0-9a-f]{7}", text)
    for what, pattern in {"command": r"`(python3 )?scripts/\w+\.py", "machine": r"\d+ cores, Python 3", "seeds": r"\b[Ss]eed|without noise|random"}.items():
        assert re.search(pattern, text), what


@pytest.mark.parametrize("data", sorted(RESULTS.rglob("*.json")), ids=lambda data: str(data.relative_to(RESULTS)))
def test_figures_say_of_which_code_they_are_and_how_they_were_made(data):
    figures = json.loads(data.read_text())
    assert re.fullmatch(r"[0-9a-f]{7}\+?", figures["commit"]) and re.fullmatch(r"[0-9a-f]{12}", figures["digest"])
    assert re.match(r"python3 (scripts|bench)/\w+\.py", figures["command"]) and figures["machine"]
    assert "seed" in data.read_text() or data.parent.name == "recordings"  # nothing is drawn there


@pytest.mark.skipif(not NOW, reason="not in a git repository")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(RESULTS)))
def test_a_page_of_other_code_says_so(page):
    assert not revision.out_of_date(page.read_text(), NOW), "python3 -m perch_eval.revision"


def _bare(source: bytes) -> str:
    """The syntax of a module without expressions that are constants: docstrings, and the dots that take their place."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [one for one in body if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant))]  # type: ignore[attr-defined]
    return ast.dump(tree)


@pytest.mark.parametrize("package", sorted((RESULTS.parents[1] / "src").glob("*/setup.py")), ids=lambda file: file.parent.name)
def test_without_docstrings_the_code_is_the_same(package):
    for file in package.parent.rglob("*.py"):
        source = file.read_bytes()
        assert _bare(revision.without_docstrings(source)) == _bare(source), file


def test_words_do_not_change_the_digest_and_figures_do(tmp_path, monkeypatch):
    file, git = tmp_path / "src" / "rate.py", ["git", "-C", str(tmp_path)]
    file.parent.mkdir()

    def written(text: str) -> str:
        file.write_text(text)
        return revision.digest()

    monkeypatch.setattr(revision, "root", lambda: tmp_path)
    subprocess.run([*git, "init", "-q"], check=True)
    file.touch()
    subprocess.run([*git, "add", "src"], check=True)
    first = written('"""Rates."""\n\nRATE = 500\n"""[Hz]"""\n\n\ndef f():\n    """Says "hello"."""\n')
    assert first == written('"""All rates\n\nof it."""\n\nRATE = 500\n"""Hertz"""\n\n\ndef f():\n    """Greets."""\n')
    assert first != written('"""Rates."""\n\nRATE = 400\n"""[Hz]"""\n\n\ndef f():\n    """Says "hello"."""\n')
    assert first != written('"""Rates."""\n\nRATE = """[Hz]"""\n\n\ndef f():\n    """Says "hello"."""\n')


def test_a_module_that_is_not_added_yet_is_part_of_the_code_and_an_ignored_one_is_not(tmp_path, monkeypatch):
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    monkeypatch.setattr(revision, "root", lambda: tmp_path)
    monkeypatch.setattr(revision, "_other_config", lambda: None)
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "rate.py").touch()
    (tmp_path / ".gitignore").write_text("*.nbi\n")
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "mine"]):
        subprocess.run([*git, *command], check=True)
    (tmp_path / "src" / "cache.nbi").touch()
    digests = [revision.digest()]
    assert not revision.commit().endswith("+")
    for text in ("GAIN = 1", "GAIN = 2"):
        (tmp_path / "src" / "gain.py").write_text(text)
        digests.append(revision.digest())
    assert len(set(digests)) == 3 and revision.commit().endswith("+")
    subprocess.run([*git, "add", "src"], check=True)
    assert revision.digest() == digests[-1]


@pytest.mark.skipif(not revision._git("rev-parse", "HEAD"), reason="not in a git repository")
def test_the_digest_without_git_is_that_of_the_same_files_with_it(tmp_path, monkeypatch):
    for name in revision._git("ls-files", "--cached", "--others", "--exclude-standard", *revision.CODE).splitlines():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(revision.root() / name, tmp_path / name, follow_symlinks=False)
    now = revision.digest()
    cache = tmp_path / "src" / "perch_core" / "perch_core" / "__pycache__" / "so3.nbi"
    cache.parent.mkdir()
    cache.touch()
    monkeypatch.setattr(revision, "root", lambda: tmp_path)
    monkeypatch.setenv("PERCH_CONFIG_DIR", str(tmp_path / "config"))
    assert (revision.commit(), revision.digest()) == ("unknown", now)
    (tmp_path / "src" / "perch_core" / "perch_core" / "so3.py").write_text("")
    assert revision.digest() != now


def test_another_configuration_is_part_of_the_code_and_its_repository_is_not_ours(tmp_path, monkeypatch):
    ours, ours_digest = revision.commit(), revision.digest()
    shutil.copytree(revision.config_dir(), tmp_path / "config")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for command in (["init", "-q"], ["add", "config"], ["commit", "-q", "-m", "mine"]):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setenv("PERCH_CONFIG_DIR", str(tmp_path / "config"))
    assert revision.commit() in ("unknown", ours.rstrip("+") + "+")
    digest = revision.digest()
    (tmp_path / "config" / "vio.yaml").write_text("")
    assert len({ours_digest, digest, revision.digest()}) == 3


def test_a_page_is_marked_once_the_code_has_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(revision, "digest", lambda: "0123456789ab")
    page = tmp_path / "page.md"
    page.write_text(f"# Results\n\n{revision.banner(['1234567'], ['0123456789ab'])}\n\n## A table\n")
    assert page.read_text().splitlines()[2] == (
        "> **Of commit 1234567** (digest 0123456789ab). What has changed since: `git diff --stat 1234567 -- src config requirements`")
    assert revision.mark([page]) == []
    monkeypatch.setattr(revision, "digest", lambda: "ba9876543210")
    assert revision.mark([page]) == [page] and revision.mark([page]) == []
    assert "> **Of commit 1234567, older than the code** (digest 0123456789ab)." in page.read_text()


def test_the_marking_explains_itself_and_marks_the_pages_of_its_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(revision, "digest", lambda: "0123456789ab")
    page = tmp_path / "page.md"
    page.write_text("# Results\n\n> **Of commit 1234567** (digest ba9876543210).\n")
    with pytest.raises(SystemExit, match="0"):
        revision.main(["--help"])
    assert "PAGE" in capsys.readouterr().out and revision.OLDER not in page.read_text()
    revision.main([str(page)])
    assert capsys.readouterr().out == f"{page}: older than the code\n" and revision.OLDER in page.read_text()


def test_results_are_of_the_code_whose_digest_they_have_whatever_was_committed_meanwhile(monkeypatch):
    monkeypatch.setattr(revision, "digest", lambda: "0123456789ab")
    text = revision.banner(["cde665f", "13d2870+", "cde665f"], ["0123456789ab"] * 3)
    assert "> **Of commits 13d2870+, cde665f** (digest 0123456789ab)." in text
    for codes in (["0123456789ab", "ba9876543210"], [""], []):
        older = revision.banner(["cde665f"], codes)
        assert "Of commit cde665f, older than the code**." in older and not revision.out_of_date(older, "0123456789ab")


@pytest.mark.skipif(not NOW, reason="not in a git repository")
def test_the_changes_of_several_commits_are_since_the_oldest():
    commits = subprocess.run(["git", "-C", str(revision.root()), "log", "--first-parent", "--format=%h", "--abbrev=7", "-20"],
                             capture_output=True, text=True, check=True).stdout.split()
    assert f"git diff --stat {commits[-1][:7]} -- src" in revision.banner(commits, [""])


def test_code_is_of_unknown_version_without_git(monkeypatch):
    monkeypatch.setenv("PATH", "/nonexistent")
    assert revision.commit() == "unknown" and re.fullmatch("[0-9a-f]{12}", revision.digest())


def test_the_front_page_shows_what_the_pages_of_results_say():
    readme = (RESULTS.parents[1] / "README.md").read_text()
    assert front_page.BEGIN + front_page.table() + front_page.END in readme, "python3 -m perch_eval.evaluation.front_page"
    assert len(readme.splitlines()) <= 200


@pytest.mark.parametrize("commits, codes, words", [
    (["1234567"], ["0123456789ab"], "commit 1234567"), (["1234567"], ["ba9876543210"], "commit 1234567, older than the code"),
    (["1234567+"], ["0123456789ab"], "commit 1234567+"), (["1234567", "7654321+"], [""], "commits 1234567, 7654321+, older than the code")])
def test_the_front_page_names_the_commit_as_the_page_of_results_does(tmp_path, monkeypatch, commits, codes, words):
    monkeypatch.setattr(revision, "digest", lambda: "0123456789ab")
    monkeypatch.setattr(front_page, "root", lambda: tmp_path)
    folder = tmp_path / "docs" / "results"
    folder.mkdir(parents=True)
    (folder / "README.md").write_text(f"# Results\n\n{revision.banner(commits, codes)}\n")
    (folder / "results.json").write_text('{"sections": []}')
    assert front_page.table().startswith(f"| condition ([{words}](docs/results/README.md)) |")


@pytest.mark.skipif(not NOW, reason="not in a git repository")
def test_the_pictures_of_the_front_page_are_of_this_code_or_said_to_be_older():
    readme = (RESULTS.parents[1] / "README.md").read_text()
    assert len(front_pictures.CAPTION.findall(readme)) == 1 and set(re.findall(r"docs/images/([^)]+)", readme)) == set(front_pictures.PICTURES)
    assert not revision.out_of_date(readme, NOW), "python3 -m perch_eval.revision, or python3 -m perch_eval.evaluation.front_pictures"


def test_the_pictures_have_the_commit_of_the_code_that_flew_and_are_marked_once_it_has_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(front_pictures, "root", lambda: tmp_path)
    monkeypatch.setattr(front_pictures, "code_version", lambda: {"commit": "1234567", "digest": "0123456789ab"})
    flown, drawn = [], []
    monkeypatch.setattr(front_pictures.subprocess, "run", lambda words: flown.append(words) or SimpleNamespace(returncode=0))
    monkeypatch.setattr(front_pictures.replay, "main", lambda words: drawn.append(words[-1]))
    readme = tmp_path / "README.md"
    readme.write_text("# perch\n\nPictures **of commit 7654321, older than the code**. Drawn.\n")
    assert front_pictures.main(["--out", str(tmp_path)]) == 0 and len(flown) == 3
    assert drawn == [str(tmp_path / "docs" / "images" / name) for name in front_pictures.PICTURES]
    assert readme.read_text() == "# perch\n\nPictures **of commit 1234567** (digest 0123456789ab). Drawn.\n"
    monkeypatch.setattr(revision, "digest", lambda: "ba9876543210")
    assert revision.mark([readme]) == [readme] and front_pictures.CAPTION.search(readme.read_text())
    assert "**of commit 1234567, older than the code** (digest 0123456789ab)." in readme.read_text()
