"""What each effect of a scene costs in time and bytes, and what it is worth in quality."""
