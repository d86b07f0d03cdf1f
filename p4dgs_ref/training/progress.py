"""The line that shows the progress of training, and the rows of training.csv."""

import shutil
import sys
import time

import numpy as np

EVERY = 20  # most iterations between two rows of training.csv; a short training has more rows
COLUMNS = ("iteration", "stage", "loss", "psnr_db", "bits_per_parameter", "anchors", "gaussians")


def psnr(image, truth):
    """-10 log10 of the mean squared error of images clipped to [0, 1], in dB; inf if equal."""
    error = float(np.mean((np.clip(image, 0, 1).astype(float) - truth) ** 2))
    return float("inf") if error == 0 else float(-10 * np.log10(error))


class Progress:
    """Called after every step, it extends `trainer.history` and writes a line to `stream`.

    A terminal shows one line that changes. Other streams get about a dozen lines, None gets none.
    """

    def __init__(self, stream=sys.stderr):
        self.stream, self.live = stream, stream is not None and stream.isatty()
        self.shown = 0.0  # when the last line was written
        self.window = []  # milliseconds, PSNR and loss of the last steps

    def __call__(self, trainer, losses, seen, view, ms):
        done, total = trainer.iteration, trainer.preset.iterations
        decibel = psnr(seen.image, view.image)
        anchors, gaussians = trainer.primitives, len(seen.index)
        stage = trainer.preset.stage(done - 1)
        if done % min(EVERY, max(total // 50, 1)) == 0 or done == total:
            row = [done, stage, losses.L_total, decibel, losses.L_rate, anchors, gaussians]
            trainer.history.append(row)
        self.window = [*self.window[-49:], (ms, decibel, losses.L_total)]
        now = time.monotonic()
        due = now - self.shown > 0.2 if self.live else done % max(total // 12, 1) == 0
        if self.stream is None or not (due or done == total):
            return
        self.shown = now
        ms, decibel, loss = np.mean(self.window, axis=0)
        left = 1e-3 * ms * (total - done)
        rate = f"{losses.L_rate:.2f}" if losses.L_rate else "-"
        # The most important numbers come first, because a narrow terminal cuts the line.
        line = (
            f"{done:{len(str(total))}d}/{total}  {left:.0f} s left  stage {stage}  "
            f"loss {loss:.4f}  PSNR {decibel:.2f} dB  {rate} bits/parameter  "
            f"{anchors} {trainer.UNIT}  {gaussians} Gaussians  {ms:.1f} ms/step"
        )
        width = shutil.get_terminal_size().columns - 1
        self.stream.write(f"\r{line[:width]}\x1b[K" if self.live else line + "\n")
        self.stream.flush()

    def close(self):
        """End the line of a terminal, so that a result or an error starts on a new one."""
        if self.live and self.shown:
            self.stream.write("\n")
            self.stream.flush()
