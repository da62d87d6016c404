"""``python -m sb3_por.zoo``: what ``python train.py`` does, for an installed package."""

import sys

from sb3_por.training.zoo import main

if __name__ == "__main__":
    sys.exit(main())
