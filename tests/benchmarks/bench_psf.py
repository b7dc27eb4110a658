"""Time per PSF and its error by method, and build rates of whole sets.

    python -m tests.benchmarks.bench_psf [--quick] [--json] [--plot FILE.png]
    python -m tests.benchmarks.bench_psf --switch 2000

The table: six eyes x 0, 20, 40 deg x pupils of 2 to 7 mm x three pixel sizes, each by
`auto`, by each method alone, and by ENZ at its released degree wherever it stands;
against the float64 quadrature, which is kept under out/ (many minutes, once).  Times
are processor time of one thread, per PSF of a batch of like ones.  The builds: slices
of the paper's grid, by wall clock on two threads and by processor time.  Writes
results/psf.json.
"""

import argparse
import json
from pathlib import Path

from tests.benchmarks.harness import print_rows, report, write_report
from tests.benchmarks.psf_rates import print_rates, rate_rows, whole_set_rows
from tests.benchmarks.psf_switch_sweep import print_sweep, sweep
from tests.benchmarks.psf_table import plot, print_summary, table_cases, table_rows
from tests.numerical.psf_cases import make_test_image


def main() -> None:
    """Print a table and write tests/benchmarks/results/psf.json, or print only JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="720p, 2 and 3 mm only")
    parser.add_argument("--json", action="store_true", help="print only JSON")
    parser.add_argument("--plot", type=Path, help="draw time against error to a .png")
    parser.add_argument(
        "--switch", type=int, metavar="N", help="only test the rule of auto on N eyes"
    )
    arguments = parser.parse_args()
    image = make_test_image()
    if arguments.switch:
        print_sweep(sweep(arguments.switch, image))
        return
    table = []
    for case in table_cases(quick=arguments.quick):
        part = table_rows(case, image)
        table += part
        if not arguments.json:
            print_rows([r for r in part if r.error_name == "psnr_db"])
    rates = rate_rows(image, quick=arguments.quick)
    if not arguments.quick:
        rates += whole_set_rows(image)
    content = report([*table, *rates])
    if arguments.plot:
        plot(table, arguments.plot)
    if arguments.json:
        print(json.dumps(content))
        return
    print_summary(table)
    print_rates(rates)
    if not arguments.quick:
        print(f"written to {write_report('psf', content)}")


if __name__ == "__main__":
    main()
