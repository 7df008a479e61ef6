"""The explorer of fronts: one HTML file on which a person chooses a policy of a front and watches its drive."""
