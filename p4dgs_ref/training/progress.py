"""What a training shows and records: rows of training.csv, and a line of progress."""

import shutil
import time
from contextlib import suppress

from ..messages import number_of
from .objective import psnr

COLUMNS = ("iteration", "stage", "loss", "psnr_db", "bits_per_parameter", "anchors", "gaussians")


class Progress:
    """Called after every step: adds rows to `trainer.history` and writes lines to `stream`.

    A terminal shows one line that changes; other streams get about a dozen lines. None is silent.
    """

    def __init__(self, stream=None):
        self.stream, self.live = stream, stream is not None and stream.isatty()
        self.shown, self.steps = time.monotonic(), 0  # the time of the last line, and steps since

    def __call__(self, trainer, losses, rendered, view):
        done, total = trainer.iteration, trainer.preset.iterations
        stage, decibel = trainer.preset.stage(done - 1), psnr(rendered.image, view.image)
        if not done % min(20, max(total // 50, 1)) or done == total:  # a row of training.csv
            trainer.history.append(
                [
                    done,
                    stage,
                    losses.L_total,
                    decibel,
                    losses.L_rate,
                    trainer.count,
                    len(rendered.index),
                ]
            )
        self.steps += 1
        seconds = time.monotonic() - self.shown
        due = seconds > 0.2 if self.live else not done % max(total // 12, 1)
        if self.stream is None or not (due or done in (1, total)):
            return
        # The most important numbers come first, because a narrow terminal cuts the line.
        left = "" if done == 1 else f"{seconds / self.steps * (total - done):.0f} s left  "
        line = (
            f"{done:{len(str(total))}d}/{total}  {left}stage {stage}  loss {losses.L_total:.4f}  "
            f"PSNR {decibel:.2f} dB at {view.camera.width}x{view.camera.height}  "
            f"{losses.L_rate:.2f} bits/parameter  {number_of(trainer.count, 'anchor')}  "
            f"{number_of(len(rendered.index), 'Gaussian')}  "
            f"{1e3 * seconds / self.steps:.1f} ms/step"
        )
        self.shown, self.steps = time.monotonic(), 0
        if self.live:
            line = f"\r{line[: shutil.get_terminal_size().columns - 1]}\x1b[K"
        end = "" if self.live and done < total else "\n"
        with suppress(OSError):  # if the disk is full or the terminal closed, training goes on
            print(line, end=end, file=self.stream, flush=True)
