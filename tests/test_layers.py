"""The rooms of `src/` and which may import which, read from the import statements (those within functions too)."""

import ast
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src"
LAYERS = (
    "utils", "stopping", "processes", "noise", "quoting", "limits", "inputs", "cli",
    "cameras", "poses", "trajectories", "data",
    "diffusion", "field", "render", "model", "averages", "exported_model", "checkpoint", "compilation",
    "fit", "metrics", "results", "distill", "stress", "stability", "training",
    "evaluation", "exports", "view", "inspection", "chart", "sweeps", "demo", "api", "pictures", "commands",
)  # fmt: skip
"""Packages and modules of `nerfdiff`: each imports only from those before it. (`metrics` comes before `distill` and
`training`, which log PSNR.)"""
GENERATOR = "procedural"
MAY_GENERATE = {"commands", "demo"}
FOR_GENERATOR = {"utils", "poses", "data"}
LIGHT = {"hydra", "omegaconf", "psutil", "filelock", "yaml"}
"""What a command may load before it knows that it has something to do."""


def modules(src: Path) -> dict[str, ast.Module]:
    paths = {".".join(path.relative_to(src).with_suffix("").parts): path for path in src.rglob("*.py")}
    return {name.removesuffix(".__init__"): ast.parse(path.read_text()) for name, path in paths.items()}


def imported(tree: ast.AST, known: dict[str, ast.Module]) -> Iterator[str]:
    """Modules that a tree's statements import: `from a import b` is `a.b` where that is a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: a relative import"
            for name in (f"{node.module}.{alias.name}" for alias in node.names):
                yield name if name in known else node.module


def room(module: str) -> str:
    package, *parts = module.split(".")
    return parts[0] if package == "nerfdiff" and parts else package


def rooms(known: dict[str, ast.Module]) -> set[tuple[str, str, str]]:
    """(a room, one that it imports from, the module that does), among `nerfdiff` and the generator."""
    arrows = {
        (room(name), room(target), name)
        for name, tree in known.items()
        if name.split(".")[0] in ("nerfdiff", GENERATOR)
        for target in imported(tree, known)
        if target.split(".")[0] in ("nerfdiff", GENERATOR) and target != "nerfdiff"
    }
    return {arrow for arrow in arrows if arrow[0] != arrow[1]}


def knot(arrows: set[tuple[str, str, str]]) -> set[str]:
    """Rooms that import themselves, by whatever way round."""
    reached = {(a, b) for a, b, _ in arrows}
    names = sorted({name for pair in reached for name in pair})
    for middle, start, end in product(names, repeat=3):  # Warshall's transitive closure
        if (start, middle) in reached and (middle, end) in reached:
            reached.add((start, end))
    return {name for name in names if (name, name) in reached}


def upwards(arrows: set[tuple[str, str, str]]) -> list[str]:
    return sorted(
        f"{module} imports from {target}"
        for start, target, module in arrows
        if {start, target} <= set(LAYERS) and LAYERS.index(target) > LAYERS.index(start)
    )


@pytest.fixture(scope="module")
def known() -> dict[str, ast.Module]:
    return modules(SRC)


def test_every_room_has_its_layer(known):
    found = {room(name) for name in known if name.startswith("nerfdiff.")}
    assert found == set(LAYERS) and len(LAYERS) == len(set(LAYERS))


def test_nothing_imports_upwards_and_there_is_no_knot(known):
    arrows = rooms(known)
    assert len(arrows) > 200
    assert upwards(arrows) == [] and knot(arrows) == set()


def test_the_generator_is_nothing_that_the_method_needs(known):
    arrows = rooms(known)
    assert {start for start, target, _ in arrows if target == GENERATOR} == MAY_GENERATE
    assert {target for start, target, _ in arrows if start == GENERATOR} == FOR_GENERATOR


def loaded(known: dict[str, ast.Module], waiting: list[str]) -> tuple[set[str], set[str]]:
    """(modules of `src/`, other packages) that load with these modules; not what is imported within a function."""
    seen, others = set(), set()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        tops = [node for node in known[name].body if isinstance(node, ast.Import | ast.ImportFrom)]
        found = set(imported(ast.Module(tops, []), known))
        others |= {target.split(".")[0] for target in found - known.keys()}
        waiting = [*waiting, *(target for target in found if target in known)]
    return seen, others


def test_processes_that_render_scenes_load_no_pytorch(known):
    seen, others = loaded(known, [name for name in known if name.split(".")[0] == GENERATOR])
    assert "nerfdiff.poses" in seen and "numpy" in others and not {"torch", "lightning", "torchvision"} & others


def test_commands_that_only_compose_load_little(known):
    """`--cfg job`, `--help` and mistakes in the overrides are answered at once."""
    seen, others = loaded(known, [name for name in known if name.startswith("nerfdiff.commands.")] + ["nerfdiff"])
    assert "nerfdiff.cli" in seen and "hydra" in others <= {*LIGHT, *sys.stdlib_module_names}


def test_knots_and_imports_upwards_are_seen(tmp_path):
    files = {
        "nerfdiff/__init__.py": "",
        "nerfdiff/utils/__init__.py": "",
        "nerfdiff/utils/files.py": "def late():\n    from nerfdiff import model\n",
        "nerfdiff/model.py": "import nerfdiff.field.field\n",
        "nerfdiff/field/field.py": "from nerfdiff.utils.files import late\nfrom procedural import mesh\n",
        "nerfdiff/distill/ngd.py": "from nerfdiff.model import NerfDiff\n",
        "procedural/mesh.py": "import numpy\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    arrows = rooms(modules(tmp_path))
    assert knot(arrows) == {"utils", "model", "field"}
    assert upwards(arrows) == ["nerfdiff.utils.files imports from model"]
    assert ("field", GENERATOR, "nerfdiff.field.field") in arrows
