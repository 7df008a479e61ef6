"""What has nothing to do with driving: files, names, errors, the machine."""
