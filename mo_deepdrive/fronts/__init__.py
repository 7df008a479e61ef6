"""Reference points and best-known fronts."""
