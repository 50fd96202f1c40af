"""Render procedural scenes: `python src/make_scenes.py scenes=cars`."""

from nerfdiff.commands.make_scenes import main

if __name__ == "__main__":
    main()
