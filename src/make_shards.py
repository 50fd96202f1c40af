"""A dataset's images in a few large files, to be streamed: `python src/make_shards.py data=srn_cars out=/fast/cars`."""

from nerfdiff.commands.make_shards import main

if __name__ == "__main__":
    main()
