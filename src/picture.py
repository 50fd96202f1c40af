"""Pictures to scenes, meshes and videos: `python src/picture.py car.jpg bus.png`."""

from nerfdiff.commands.picture import main

if __name__ == "__main__":
    main()
