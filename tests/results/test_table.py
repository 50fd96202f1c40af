import io

import pytest
from rich.console import Console

from nerfdiff.results.row import ResultRow
from nerfdiff.results.table import markdown, rich_table, write_markdown

ROWS = [
    ResultRow(
        run_id="1", strategy="none", psnr=23.456, params=22_700_000, render_s={"n": 5, "median": 0.0123, "iqr": 0}
    ),
    ResultRow(run_id="2", strategy="mean|image", psnr=9.1),
]


def test_markdown_shows_only_columns_that_have_values():
    assert markdown(ROWS).splitlines() == [
        "| strategy | PSNR ↑ | render, s/view | parameters, M |",
        "| --- | --- | --- | --- |",
        "| none | 23.46 | 0.0123 | 22.7 |",
        "| mean\\|image | 9.10 | – | – |",
    ]


def test_failures_are_shown():
    rows = [*ROWS, ResultRow(run_id="3", strategy="ngd", status="oom")]
    lines = markdown(rows).splitlines()
    assert lines[0].endswith("| status |")
    assert lines[-1] == "| ngd | – | – | – | oom |"
    assert lines[2].endswith("| ok |")


def test_numbers_that_are_not_finite_are_shown():
    assert "| nan |" in markdown([ResultRow(run_id="1", psnr=float("nan"))])


def test_rich_and_markdown_show_the_same(tmp_path):
    console = Console(file=io.StringIO(), width=120)
    console.print(rich_table(ROWS, 120, title="Held-out views"))
    printed = console.file.getvalue()
    for text in ("Held-out views", "strategy", "PSNR ↑", "23.46", "mean|image", "0.0123"):
        assert text in printed
    write_markdown(tmp_path / "table.md", ROWS)
    assert (tmp_path / "table.md").read_text() == markdown(ROWS)


@pytest.mark.parametrize("rows", [1, 2])
def test_names_with_brackets_are_no_markup(rows):
    found = [
        ResultRow(run_id=str(n), strategy="s[bold]" + "y" * 40, dataset="x[/bold]/test", weights="\x1b[2Jw")
        for n in range(rows)
    ]
    console = Console(file=io.StringIO(), width=120)
    console.print(rich_table(found, 120, title="of x[/bold]"))
    text = "".join(console.file.getvalue().split())  # a narrow table breaks lines
    assert all(word in text for word in ("s[bold]", "x[/bold]/test", "[2Jw", "ofx[/bold]")) and "\x1b" not in text


def test_a_narrow_table_keeps_whole_columns_and_names_the_others():
    rows = [
        ResultRow(run_id=name, strategy=name, dataset="srn_cars/test", seed=0, psnr=20.0, ssim=0.5, params=10**6)
        for name in ("none", "cdm")
    ]
    console = Console(file=io.StringIO(), width=40)
    console.print(rich_table(rows, console.width))
    lines = console.file.getvalue().splitlines()
    assert {len(line) for line in lines[:6]} == {len(lines[0])} and len(lines[0]) <= 40
    text = " ".join(" ".join(lines).split())
    for part in ("none", "cdm", "20.00", "0.500", "dataset srn_cars/test, seed 0", "too narrow for: parameters, M"):
        assert part in text
    assert "…" not in text
