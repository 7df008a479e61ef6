"""What the algorithms learn with: networks and their optimiser, collection and storage, preferences, guides."""
