"""What placegraph is made and measured with; the library never imports it."""
