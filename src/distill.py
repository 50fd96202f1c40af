"""One picture, or every test scene, to a field: `python src/distill.py ckpt=demo image=car.png strategy=ngd`."""

from nerfdiff.commands.distill import main

if __name__ == "__main__":
    main()
