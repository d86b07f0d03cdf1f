"""The laboratory: what measures the paper, compares it and teaches it; see its README.md."""


class StudyError(ValueError):
    """A mistake in what a study is asked for: one line with its name and what was expected."""
