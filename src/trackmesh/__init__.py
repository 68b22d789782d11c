"""trackmesh: an open track server over Zenoh."""
