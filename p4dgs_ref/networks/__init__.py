"""Parameters of networks and anchors, their initial values, Adam, and learning-rate schedules."""
