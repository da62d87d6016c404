"""One training run: the command line of train.py."""
