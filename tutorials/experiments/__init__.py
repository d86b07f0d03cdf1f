"""What the project found out for itself: experiments, which use the package from outside."""

from pathlib import Path

RECORDS = Path(__file__).parent / "records"
