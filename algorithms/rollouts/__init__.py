"""Experience: its collection, buffers and advantages, and guides and preferences under which it is collected."""
