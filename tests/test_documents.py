"""Links, paths, commands and `make` targets in the documents, and the site that is made of them."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from nerfdiff.cli import CONF, check_overrides, load_config
from nerfdiff.quoting import gather_lists, quote_values
from nerfdiff.utils.errors import ConfigError

PROJECT = Path(__file__).parents[1]
DOCUMENTS = sorted([*PROJECT.glob("*.md"), *PROJECT.glob("docs/*.md"), *PROJECT.glob("assets/**/*.md")])
FOLDERS = ("assets", "benchmarks", "conf", "docs", "notebooks", "scripts", "src", "tests")
MADE = ("docs/speed_accuracy/chart",)
"""Paths that commands make."""
OWN_CONFIG = "--config-dir"
CODE = re.compile(r"^```.*?^```|^(?: {4}).*?$|`[^`\n]+`", re.S | re.M)
LINK = re.compile(r"\]\(([^)\s]+)\)")


def names(paths: list[Path]) -> list[str]:
    return [str(path.relative_to(PROJECT)) for path in paths]


def anchors(text: str) -> set[str]:
    """Of headings, as GitHub and the site make them."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def wrong_links(path: Path, text: str) -> list[str]:
    """Relative links of a document that lead nowhere."""
    wrong = []
    for link in LINK.findall(CODE.sub("", text)):
        target, _, anchor = link.partition("#")
        if "://" in link or link.startswith("mailto:"):
            continue
        file = (path.parent / target).resolve() if target else path
        if not file.exists() or (anchor and anchor not in anchors(text if file == path else file.read_text())):
            wrong.append(link)
    return wrong


def wrong_paths(text: str) -> list[str]:
    """Paths within the project, in code, that are not there."""
    words = re.findall(rf"(?<![\w./-])((?:{'|'.join(FOLDERS)})/[\w./-]*[\w/])", "\n".join(CODE.findall(text)))
    own = ("conf/",) if OWN_CONFIG in text else ()  # a reader's, beside the project's
    return [word for word in words if not (PROJECT / word).exists() and not word.startswith((*MADE, *own))]


def commands(text: str) -> Iterator[tuple[str, list[str]]]:
    """(path, arguments) of every Python command in code; `…` stands for what a reader puts in."""
    for code in CODE.findall(text):
        for line in re.sub(r"\\\n\s*", " ", code.strip("`")).splitlines():
            if found := re.search(r"(?:^|[ ;])python ((?:src|benchmarks)/\w+\.py)(.*)", line):
                yield found[1], shlex.split(found[2], comments=True)


def wrong_commands(text: str) -> list[str]:
    sources = "\n".join(path.read_text() for path in PROJECT.glob("benchmarks/*.py"))
    wrong = []
    for path, words in commands(text):
        if not (PROJECT / path).is_file():
            wrong.append(path)
        elif path.startswith("src/") and OWN_CONFIG not in words:
            try:
                words = gather_lists(Path(path).stem, words)
                check_overrides(Path(path).stem, quote_values(words))
                if not {"-m", "--multirun"} & set(words) and not any("," in word for word in words):
                    load_config(Path(path).stem, [word for word in words if "=" in word])
            except ConfigError as error:
                wrong.append(f"{path} {shlex.join(words)}: {error}")
        elif path.startswith("benchmarks/"):
            options = [word for word in words if word.startswith("--")]
            wrong += [f"{path} {option}" for option in options if f'"{option}"' not in sources]
    return wrong


def wrong_targets(text: str) -> list[str]:
    targets = re.search(r"^\.PHONY: (.+)$", (PROJECT / "Makefile").read_text(), re.M)[1].split()
    return [name for code in CODE.findall(text) for name in re.findall(r"\bmake ([a-z]+)", code) if name not in targets]


@pytest.mark.parametrize("path", DOCUMENTS, ids=names(DOCUMENTS))
def test_what_documents_name_is_there(path):
    text = path.read_text()
    assert wrong_links(path, text) == []
    assert wrong_paths(text) == []
    assert wrong_commands(text) == []
    assert wrong_targets(text) == []


def test_what_is_not_there_is_found(tmp_path):
    text = """# Two words, and more
[a](#two-words-and-more) [b](#three) [c](gone.md) [d](https://example.org/x) `[e](code.md)`
`src/nerfdiff/gone.py` and `python src/train.py modle=tiny`, `make tea`, `python src/gone.py`

    python benchmarks/all.py --hours 3

```bash
make test
python src/train.py model=tiny \\
    data=nowhere    # a comment
python src/distill.py ckpt=demo data.root=… 'picture={fov:3}'
python src/train.py --help
```
"""
    path = tmp_path / "page.md"
    path.write_text(text)
    assert wrong_links(path, text) == ["#three", "gone.md"]
    assert wrong_paths(text) == ["src/nerfdiff/gone.py", "src/gone.py"]
    assert [line.split(":")[0] for line in wrong_commands(text)] == [
        "src/train.py modle=tiny", "src/gone.py", "benchmarks/all.py --hours", "src/train.py model=tiny data=nowhere",
    ]  # fmt: skip
    assert wrong_targets(text) == ["tea"]
    own = "`python src/train.py --config-dir mine data=boxes` reads `conf/data/boxes.yaml`, not `src/gone.py`"
    assert wrong_paths(own) == ["src/gone.py"] and wrong_commands(own) == []


def test_the_readme_is_read_in_three_minutes_and_names_choices_that_exist():
    text = (PROJECT / "README.md").read_text()
    assert len(text.splitlines()) <= 150 and len(text.split()) <= 1500
    rows = dict(re.findall(r"^\| `(\w+)`(?: \([\w, ]+\))? \| (.+) \|$", text.partition("## Configure")[2], re.M))
    assert len(rows) > 6
    for group, said in rows.items():
        assert set(re.findall(r"`(\w+)`", said)) <= {file.stem for file in (CONF / group).glob("*.yaml")}, group


def test_the_site_is_built(tmp_path, monkeypatch):
    pytest.importorskip("mkdocs", reason="the site's tools are an extra: pip install -e '.[docs]'")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config as load_site

    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    monkeypatch.chdir(PROJECT)
    build(load_site("mkdocs.yml", strict=True, site_dir=str(tmp_path)))
    assert "eps_guide" in (tmp_path / "reference/index.html").read_text()  # a docstring
    assert {page.stem for page in PROJECT.glob("docs/*.md")} - {"README"} <= {page.name for page in tmp_path.iterdir()}
