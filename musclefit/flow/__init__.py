"""The marching loop: handles on a path become a deformation made of safe steps."""
