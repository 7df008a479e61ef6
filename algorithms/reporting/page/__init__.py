"""The page of the package: driving in a browser, and choosing a policy of a front, without a server or a network."""
