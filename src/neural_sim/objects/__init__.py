"""Objects: procedural meshes, YCB layout, BOP models, any folder of meshes, photographs with or without cameras."""
