"""The pushes of one object from bags, with recorded poses or poses tracked in depth images."""
