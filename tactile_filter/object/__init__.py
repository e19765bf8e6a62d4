"""Several sensors on one object: their contacts as one belief over the object's pose."""
