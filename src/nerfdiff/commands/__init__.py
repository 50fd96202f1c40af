"""The commands: in a checkout `python src/train.py …`, installed `nerfdiff-train …`."""
