"""What is done to break placegraph, and what became of it: a row each of the table `reliability`."""
