"""Regenerate ``population.json`` from measured people.

python -m training.population_table tests/data/peripheral_wavefronts.npz
"""

import argparse
import json
from pathlib import Path

import numpy as np

from estimator.periphery.population import (
    POPULATION_FILE,
    Population,
    load_measured_eyes,
)

SOURCE = (
    "Jaeken & Artal, IOVS 53(7), 2012: half of 65 people's eyes along the horizontal "
    "meridian, 4 mm, as distributed with ISETBio (MIT license)"
)


def main() -> None:
    """Fit the population and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("people", type=Path, help="peripheral_wavefronts.npz")
    people = load_measured_eyes(parser.parse_args().people)
    count = int(np.isfinite(people.axis_um).all(axis=-1).sum())
    data = {"source": SOURCE, "eyes": count, **Population.fit(people).to_json()}
    POPULATION_FILE.write_text(json.dumps(data) + "\n", encoding="utf-8")
    print(f"{POPULATION_FILE.name}: {count} eyes")


if __name__ == "__main__":
    main()
