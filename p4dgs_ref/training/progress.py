"""The line that shows how training is getting on, and the numbers behind training.csv."""
import sys
import time

import numpy as np

EVERY = 20         # iterations between two rows of training.csv
COLUMNS = ("iteration", "stage", "loss", "psnr_db", "bits_per_parameter", "anchors", "gaussians")


def psnr(image, truth):
    """-10 log10 of the mean squared error of images clipped to [0, 1], in dB; inf where they are equal."""
    error = float(np.mean((np.clip(image, 0, 1).astype(float) - truth) ** 2))
    return float("inf") if error == 0 else -10 * np.log10(error)


class Progress:
    """Call after every step: keeps trainer.history, and writes one line to `stream` unless it is None.

    On a terminal the line is redrawn; elsewhere it is printed a dozen times in all.
    """

    def __init__(self, stream=sys.stderr):
        self.stream, self.live = stream, stream is not None and stream.isatty()
        self.start, self.shown, self.first = time.monotonic(), 0.0, None
        self.window = []

    def __call__(self, trainer, losses, seen, view, ms):
        done, total = trainer.iteration, trainer.preset.iterations
        self.first = done - 1 if self.first is None else self.first
        if done % EVERY == 0 or done == total:
            trainer.history.append([done, trainer.preset.stage(done - 1), losses.L_total, psnr(seen.image, view.image),
                                    losses.L_rate, len(trainer.mask), len(seen.index)])
        if self.stream is None:
            return
        self.window = [*self.window[-49:], (ms, psnr(seen.image, view.image), losses.L_total)]
        now = time.monotonic()
        due = now - self.shown > 0.2 if self.live else done % max(total // 12, 1) == 0
        if due or done == total:
            self.shown = now
            self.write(trainer, losses, seen, now, done, total)

    def write(self, trainer, losses, seen, now, done, total):
        ms, decibel, loss = np.mean(self.window, axis=0)
        left = (now - self.start) / max(done - self.first, 1) * (total - done)
        rate = f"{losses.L_rate:5.2f} bit/param" if losses.L_rate else "  -   bit/param"
        line = (f"{done:6d}/{total} stage {trainer.preset.stage(done - 1)} loss {loss:.4f} PSNR {decibel:5.2f} dB {rate} "
                f"{len(trainer.mask)} anchors {len(seen.index)} Gaussians {ms:5.1f} ms/step {left:4.0f} s left")
        self.stream.write(f"\r{line}\x1b[K" if self.live else line + "\n")
        if self.live and done == total:
            self.stream.write("\n")
        self.stream.flush()
