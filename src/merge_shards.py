"""One table and one row from all shards of a run: `python src/merge_shards.py shards=runs/distill/srn_cars`."""

from nerfdiff.commands.merge_shards import main

if __name__ == "__main__":
    main()
