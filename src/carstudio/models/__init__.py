"""Category models of cars behind one interface."""
