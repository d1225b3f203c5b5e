"""Sources of objects: procedural meshes, YCB and BOP layouts, any folder of meshes, and photographs."""
