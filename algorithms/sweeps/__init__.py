"""Many runs from one YAML file: settings, manifest, search, and the engines that make the runs."""
