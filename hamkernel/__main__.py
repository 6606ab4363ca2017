"""`python -m hamkernel`: the paper's experiments; with `learn`, a field from CSV files."""

import argparse
import sys

import jax


def main() -> None:
    """Reproduce the paper and print its tables beside the published ones; or learn."""
    if sys.argv[1:2] == ["learn"]:
        _learn(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(
        prog="python -m hamkernel",
        description="Reproduce the experiments of Smith & Egeland (2023): tables on the terminal, "
        "results.json and figures in a folder.",
        epilog="python -m hamkernel learn --help: from logged runs in CSV files to a field.",
    )
    parser.add_argument("--out", default="results", help="folder for the files (%(default)s)")
    parser.add_argument(
        "--seeds", type=int, default=100, help="number of noise seeds (%(default)s)"
    )
    parser.add_argument(
        "--no-tune", dest="tune", action="store_false", help="the paper's hyperparameters alone"
    )
    arguments = parser.parse_args()
    if arguments.seeds < 1:
        parser.error("--seeds must be at least 1")

    print(_plan(arguments.out, arguments.seeds, arguments.tune), flush=True)
    jax.config.update("jax_enable_x64", True)  # before any array is made
    from hamkernel._show import printable
    from hamkernel.paper import reproduce, retune

    def show(table: str) -> None:
        print(printable(f"\n{table}"), flush=True)

    try:
        _, files = reproduce(arguments.out, arguments.seeds, show=show)
    except OSError as error:
        parser.error(f"--out {arguments.out} cannot be written: {error}")
    if arguments.tune:
        _, more = retune(arguments.out, arguments.seeds, show=show)
        files += more[1:]  # results.json is there
    print("\nWritten:", *(f"  {file}" for file in files), sep="\n")


def _learn(arguments: list[str]) -> None:
    """From CSV files to a report, a field and a script."""
    jax.config.update("jax_enable_x64", True)  # before any array is made
    from hamkernel._command import run
    from hamkernel._show import printable

    run(arguments, lambda text: print(printable(text), flush=True))


def _plan(out: str, seeds: int, tune: bool) -> str:
    """The plan in words, with the minutes that it takes on two idle cores."""
    # Half a minute compiles and draws, and 100 seeds take as long (README, "Install").
    first = 0.5 + 0.5 * seeds / 100
    lines = [
        f"Reproducing Smith & Egeland (2023) with {seeds} noise seed{'s' * (seeds > 1)}:",
        f"  fits and tables, then figures: about {first:.1f} min",
    ]
    if tune:
        lines.append("  hyperparameters tuned on their data: about 1.0 min")
    lines.append(f"on two idle cores. Files go to {out}/.")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
