"""`python -m p4dgs_ref.lab`: times the renderer, the parts of a training step, and the coder."""

from ..arithmetic import prepare


def main():
    """Print the benchmark."""
    prepare()
    from . import bench  # loads NumPy

    print(bench.to_text(bench.bench()))


if __name__ == "__main__":
    main()
