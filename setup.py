"""Build step that pyproject.toml cannot express: put conf/ and assets/ into the package of a wheel."""

from pathlib import Path
from shutil import copytree, rmtree

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildPy(build_py):
    """An editable install reads both from the checkout."""

    def run(self) -> None:
        super().run()
        for name in () if self.editable_mode else ("conf", "assets"):
            target = Path(self.build_lib) / "nerfdiff" / name
            rmtree(target, ignore_errors=True)  # what an earlier build left
            copytree(Path(__file__).parent / name, target)


setup(cmdclass={"build_py": BuildPy})
