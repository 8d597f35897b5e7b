"""Commands of the workshop: `swiftbot up`, `down`, `demo`, `sim`, `bench`, `train`."""
