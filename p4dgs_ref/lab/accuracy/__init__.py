"""What accuracy costs in time: eight studies, each with its diagrams, its tables and a reading."""
