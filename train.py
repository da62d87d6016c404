"""Train an agent with the RL Zoo's command line: ``python train.py --algo sac_por --env PourWater-v0``."""

import sys

from sb3_por.training.zoo import main

if __name__ == "__main__":
    sys.exit(main())
