"""A page in the browser beside a running graph or a recording; nothing imports it."""
