"""What is shown: tables, learning curves, figures of fronts, videos."""
