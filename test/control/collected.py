"""What tests of a collection put in place of its images and its folder."""


class Look:
    """The bench's images are what there is to be seen in them."""

    def forget(self) -> None:
        pass

    def __call__(self, image, without_contact):
        return image


class Store:
    """Keeps samples in a list, and whatever else it is given."""

    def __init__(self) -> None:
        self.captures, self.surfaces, self.references = [], [], []

    def missing(self, samples):
        return list(range(1, samples + 1))

    def surface(self):
        return self.surfaces[-1] if self.surfaces else None

    def keep_reference(self, image):
        self.references.append(image)

    def keep_surface(self, T_base_f, assumed, touches):
        self.surfaces.append(T_base_f)

    def keep(self, capture, image):
        self.captures.append(capture)

    def finish(self):
        pass
