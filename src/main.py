"""``python -m src.main`` in a checkout; the same as the installed ``neural-sim``."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from neural_sim.main import main

if __name__ == "__main__":
    main()
