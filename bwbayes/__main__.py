"""``python -m bwbayes`` is the command ``bwbayes``, of the Python that is meant."""

from bwbayes.app.commands.cli import main

if __name__ == "__main__":
    main()
