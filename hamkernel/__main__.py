"""`python -m hamkernel`: the paper's experiments from the first array to the last figure."""

import argparse

import jax


def main() -> None:
    """Reproduce the paper and print its tables beside the published ones."""
    parser = argparse.ArgumentParser(
        prog="python -m hamkernel",
        description="Reproduce the experiments of Smith & Egeland (2023): tables on the terminal, "
        "results.json and figures in a folder.",
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

    jax.config.update("jax_enable_x64", True)  # before any array is made
    from hamkernel.paper import reproduce, retune

    try:
        text, files = reproduce(arguments.out, arguments.seeds)
    except OSError as error:
        parser.error(f"--out {arguments.out} cannot be written: {error}")
    print(text, flush=True)
    if arguments.tune:
        text, more = retune(arguments.out, arguments.seeds)
        print(f"\n{text}")
        files += more[1:]  # results.json is there
    print("\nWritten:", *(f"  {file}" for file in files), sep="\n")


if __name__ == "__main__":
    main()
