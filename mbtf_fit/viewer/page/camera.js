// A pinhole camera that looks at a point, as that of mbtf-gen reference: its field of view at the target is
// so many tiles across.

// Fields of view in tile widths, and the share of a picture that a shape fills.
const NEAR_AND_FAR = [0.05, 400],
  FILL = 0.9;

class Camera {
  constructor(state) {
    Object.assign(this, {
      elevation: 50,
      azimuth: -90,
      tiles_across: 3,
      target: [0.5, 0.5, 0],
      field_of_view: 20,
      ...state,
    });
  }

  get distance() {
    return this.tiles_across / (2 * Math.tan(radians(this.field_of_view) / 2));
  }

  get position() {
    return add(this.target, scaled(fromAngles(this.elevation, this.azimuth), this.distance));
  }

  // Forward, right, up. The picture turns with the azimuth, also seen from straight above.
  get frame() {
    const forward = scaled(fromAngles(this.elevation, this.azimuth), -1),
      right = fromAngles(0, this.azimuth + 90);
    return [forward, right, cross(right, forward)];
  }

  // From the world to clip coordinates, for a picture of this width over height.
  viewProjection(proportion) {
    const [forward, right, up] = this.frame,
      p = this.position,
      x = 1 / Math.tan(radians(this.field_of_view) / 2);
    const [near, far] = [this.distance * 0.02, this.distance * 50 + 1000];
    const view = [
      right[0],
      up[0],
      -forward[0],
      0,
      right[1],
      up[1],
      -forward[1],
      0,
      right[2],
      up[2],
      -forward[2],
      0,
      -dot(right, p),
      -dot(up, p),
      dot(forward, p),
      1,
    ];
    const depth = (near + far) / (near - far);
    const projection = [
      x,
      0,
      0,
      0,
      0,
      x * proportion,
      0,
      0,
      0,
      0,
      depth,
      -1,
      0,
      0,
      (2 * near * far) / (near - far),
      0,
    ];
    return product(projection, view);
  }

  // Turn by degrees.
  orbit(right, up, lowest) {
    this.azimuth = ((this.azimuth - right + 540) % 360) - 180;
    this.elevation = clamp(this.elevation + up, lowest, 90);
  }

  // Move the target so that the picture moves by shares of its width.
  pan(right, up) {
    const [, r, u] = this.frame,
      size = this.tiles_across;
    this.target = add(this.target, add(scaled(r, -right * size), scaled(u, -up * size)));
  }

  zoom(factor) {
    this.tiles_across = clamp(this.tiles_across * factor, ...NEAR_AND_FAR);
  }

  // Go where points around the target (x, y, z of each) just fit a picture of this width over height.
  fit(points, proportion) {
    const [forward, right, up] = this.frame,
      half = Math.tan(radians(this.field_of_view) / 2);
    let distance = 0;
    for (let k = 0; k < points.length; k += 3) {
      const p = add([points[k], points[k + 1], points[k + 2]], scaled(this.target, -1));
      const across = Math.max(Math.abs(dot(p, right)), Math.abs(dot(p, up)) * proportion);
      distance = Math.max(distance, across / (FILL * half) - dot(p, forward));
    }
    this.tiles_across = clamp(2 * half * distance, ...NEAR_AND_FAR);
  }
}
