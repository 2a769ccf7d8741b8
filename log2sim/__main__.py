"""Run the command line as `python -m log2sim`."""

from log2sim.cli import main

if __name__ == "__main__":
    main()
