/* A uniform rod on a hinge with viscous damping d; theta = 0 hangs down. */
static void derive(double *v, double time) {
    v[der_theta] = v[omega];
    v[der_omega] = -3 * v[g] / (2 * v[l]) * sin(v[theta]) + 3 * (v[torque] - v[d] * v[omega]) / (v[m] * v[l] * v[l]);
    v[energy] = v[m] * v[l] * (v[l] * v[omega] * v[omega] / 6 - v[g] * cos(v[theta]) / 2);
}
static void indicate(const double *v, double *z) {}
static int event(double *v) { return 0; }
