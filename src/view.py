"""Turn scenes by hand in a browser: `python src/view.py field=out/car/field.safetensors`."""

from nerfdiff.commands.view import main

if __name__ == "__main__":
    main()
