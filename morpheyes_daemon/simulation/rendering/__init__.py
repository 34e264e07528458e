"""The renderer: scene, meshes, textures, rasterizer, shading."""
