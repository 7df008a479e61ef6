"""Search over action sequences: best-known fronts of a scenario, and which scenarios can be solved at all."""
