"""nerfstudio's own methods, the real ones, each as a `render(camera)` behind a process of nerfstudio's environment."""
