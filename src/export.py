"""A model's weights for sharing, or a scene for other programs: `python src/export.py field=… format=glb,ply,mp4`."""

from nerfdiff.commands.export import main

if __name__ == "__main__":
    main()
