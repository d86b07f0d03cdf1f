"""The laboratory: what measures the paper, compares it and teaches it; see its README.md."""
