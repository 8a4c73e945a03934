"""Cars and photographs made here, with exact truth."""
