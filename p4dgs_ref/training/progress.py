"""The line that shows how training is getting on, and the numbers behind training.csv."""

import shutil
import sys
import time

import numpy as np

EVERY = 20  # most iterations between two rows of training.csv; short trainings get a row more often
COLUMNS = ("iteration", "stage", "loss", "psnr_db", "bits_per_parameter", "anchors", "gaussians")


def psnr(image, truth):
    """-10 log10 of the mean squared error of images clipped to [0, 1], in dB; inf where they are equal."""
    error = float(np.mean((np.clip(image, 0, 1).astype(float) - truth) ** 2))
    return float("inf") if error == 0 else float(-10 * np.log10(error))


class Progress:
    """Call after every step: keeps trainer.history, and writes one line to `stream` unless it is None.

    On a terminal the line is redrawn; elsewhere it is printed a dozen times in all.
    """

    def __init__(self, stream=sys.stderr):
        self.stream, self.live = stream, stream is not None and stream.isatty()
        self.start, self.shown, self.first, self.open = time.monotonic(), 0.0, None, False
        self.window = []

    def __call__(self, trainer, losses, seen, view, ms):
        done, total = trainer.iteration, trainer.preset.iterations
        self.first = done - 1 if self.first is None else self.first
        kept = done % min(EVERY, max(total // 50, 1)) == 0 or done == total
        if not kept and self.stream is None:
            return
        decibel = psnr(seen.image, view.image)
        if kept:
            trainer.history.append(
                [
                    done,
                    trainer.preset.stage(done - 1),
                    losses.L_total,
                    decibel,
                    losses.L_rate,
                    len(trainer.mask),
                    len(seen.index),
                ]
            )
        if self.stream is None:
            return
        self.window = [*self.window[-49:], (ms, decibel, losses.L_total)]
        now = time.monotonic()
        due = now - self.shown > 0.2 if self.live else done % max(total // 12, 1) == 0
        if due or done == total:
            self.shown = now
            self.write(trainer, losses, seen, now, done, total)

    def write(self, trainer, losses, seen, now, done, total):
        """The line, what matters most first: a narrow terminal shows as much of it as fits."""
        ms, decibel, loss = np.mean(self.window, axis=0)
        left = (now - self.start) / max(done - self.first, 1) * (total - done)
        rate = f"{losses.L_rate:.2f}" if losses.L_rate else "-"
        line = (
            f"{done:{len(str(total))}d}/{total}  {left:.0f} s left  stage {trainer.preset.stage(done - 1)}  "
            f"loss {loss:.4f}  PSNR {decibel:.2f} dB  {rate} bits/parameter  {len(trainer.mask)} anchors  "
            f"{len(seen.index)} Gaussians  {ms:.1f} ms/step"
        )
        if self.live:
            self.open, line = True, f"\r{line[: shutil.get_terminal_size().columns - 1]}\x1b[K"
        self.stream.write(line if self.live else line + "\n")
        self.stream.flush()

    def close(self):
        """Leave the line, so that what follows, a result or an error, stands on its own."""
        if self.open:
            self.stream.write("\n")
            self.stream.flush()
