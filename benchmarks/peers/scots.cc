// One problem, solved by the sparse SCOTS 0.2, whose headers are on the include path:
//   scots PROBLEM FILE DISTANCE...
// with the distances of cells and of input values, and for `pendulum` the gap of each state after them. FILE gets a byte per cell, 1
// where it wins (for games of reaching, the targets too), and for `dcdc` and `pendulum` a byte per cell and input, 1 where the input
// is valid. Cells count with the first state fastest. Printed: cells, inputs, transitions, winning cells without targets, CPU seconds
// of the abstraction and of the game, and the largest resident memory until then in KiB.

#include <array>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <limits>
#include <string>
#include <vector>

#include <sys/resource.h>

#include "RungeKutta4.hh"
#include "scots.hh"

namespace {

using Index = scots::abs_type;
template <std::size_t n>
using Vector = std::array<double, n>;

const double degree = M_PI / 180;

double seconds() {
  rusage usage;
  getrusage(RUSAGE_SELF, &usage);
  return usage.ru_utime.tv_sec + usage.ru_stime.tv_sec + 1e-6 * (usage.ru_utime.tv_usec + usage.ru_stime.tv_usec);
}

// Largest resident memory in KiB. What getrusage says begins with that of the process which started this one.
long memory() {
  std::ifstream status("/proc/self/status");
  for (std::string word; status >> word;)
    if (word == "VmHWM:") {
      long value = 0;
      status >> value;
      return value;
    }
  return -1;
}

// What a problem is given by, with its dynamics, growth bound and sets in the struct that derives from it.
template <std::size_t n, std::size_t m>
struct Problem {
  using State = Vector<n>;
  using Input = Vector<m>;
  enum { states = n, inputs = m };
  State low, high, eta, error;
  Input least, most, step;
  bool measured = false;

  void distances(char** given) {
    for (std::size_t k = 0; k < n; k++) eta[k] = std::atof(given[k]);
    for (std::size_t k = 0; k < m; k++) step[k] = std::atof(given[n + k]);
  }
  bool avoided(const State&) const { return false; }
  // Is the cell about x inside of a box?
  bool inside(const State& x, const State& a, const State& b) const {
    for (std::size_t k = 0; k < n; k++)
      if (!(a[k] <= x[k] - eta[k] / 2 - error[k] && x[k] + eta[k] / 2 + error[k] <= b[k])) return false;
    return true;
  }
};

struct Dcdc : Problem<2, 1> {
  enum { reach = false };
  explicit Dcdc(char** given) {
    low = {{1.15, 5.45}}, high = {{1.55, 5.85}}, error = {{0, 0}}, least = {{1}}, most = {{2}};
    distances(given);
  }
  // coupling: the sign with which one state enters the other's rate, and of the constant.
  static void rate(State& out, const State& x, const Input& u, double sign, double constant) {
    const double xc = 70, xl = 3, rc = 0.005, rl = 0.05, ro = 1;
    if (u[0] == 1) {
      out[0] = -rl / xl * x[0] + constant / xl;
      out[1] = -1 / (xc * (ro + rc)) * x[1];
    } else {
      out[0] = -(rl + ro * rc / (ro + rc)) / xl * x[0] + sign * ro / (5 * (ro + rc)) / xl * x[1] + constant / xl;
      out[1] = 5 * ro / (ro + rc) / xc * x[0] - 1 / (ro + rc) / xc * x[1];
    }
  }
  void flow(State& x, const Input& u) const {
    auto f = [](State& out, const State& y, const Input& v) { rate(out, y, v, -1, 1); };
    scots::runge_kutta_fixed4(f, x, u, 2, 0.5, 5);
  }
  void grow(State& r, const Input& u) const {
    auto f = [](State& out, const State& y, const Input& v) { rate(out, y, v, 1, 0); };
    scots::runge_kutta_fixed4(f, r, u, 2, 0.5, 5);
  }
  bool wanted(const State& x) const { return inside(x, low, high); }
};

struct Vehicle : Problem<3, 2> {
  enum { reach = true };
  explicit Vehicle(char** given) {
    low = {{0, 0, -3.5}}, high = {{10, 10, 3.5}}, error = {{0, 0, 0}}, least = {{-1, -1}}, most = {{1, 1}};
    distances(given);
  }
  void flow(State& x, const Input& u) const {
    auto f = [](State& out, const State& y, const Input& v) {
      const double slip = std::atan(std::tan(v[1]) / 2.0);
      out[0] = v[0] * std::cos(slip + y[2]) / std::cos(slip);
      out[1] = v[0] * std::sin(slip + y[2]) / std::cos(slip);
      out[2] = v[0] * std::tan(v[1]);
    };
    scots::runge_kutta_fixed4(f, x, u, 3, 0.3, 10);
  }
  void grow(State& r, const Input& u) const {
    const double turn = std::tan(u[1]), by = std::abs(u[0]) * std::sqrt(turn * turn / 4.0 + 1) * r[2] * 0.3;
    r[0] += by;
    r[1] += by;
  }
  bool avoided(const State& x) const {
    static const double walls[15][4] = {{1, 1.2, 0, 9},       {2.2, 2.4, 0, 5},     {2.2, 2.4, 6, 10},    {3.4, 3.6, 0, 9},
                                        {4.6, 4.8, 1, 10},    {5.8, 6, 0, 6},       {5.8, 6, 7, 10},      {7, 7.2, 1, 10},
                                        {8.2, 8.4, 0, 8.5},   {8.4, 9.3, 8.3, 8.5}, {9.3, 10, 7.1, 7.3},  {8.4, 9.3, 5.9, 6.1},
                                        {9.3, 10, 4.7, 4.9},  {8.4, 9.3, 3.5, 3.7}, {9.3, 10, 2.3, 2.5}};
    const double a = eta[0] / 2 + 1e-10, b = eta[1] / 2 + 1e-10;
    for (const auto& w : walls)
      if (w[0] - a <= x[0] && x[0] <= w[1] + a && w[2] - b <= x[1] && x[1] <= w[3] + b) return true;
    return false;
  }
  bool wanted(const State& x) const { return inside(x, {{9, 0, -10}}, {{9.5, 0.5, 10}}); }
};

struct Aircraft : Problem<3, 2> {
  enum { reach = true };
  explicit Aircraft(char** given) {
    low = {{58, -3 * degree, 0}}, high = {{83, 0, 56}}, least = {{0, 0}}, most = {{32000, 8 * degree}};
    error = {{0.0125, 0.0025 / 180 * M_PI, 0.05}}, measured = true;
    distances(given);
  }
  void flow(State& x, const Input& u) const {
    auto f = [](State& out, const State& y, const Input& v) {
      const double mass = 60000, weight = mass * 9.81, c = 1.25 + 4.2 * v[1];
      out[0] = (v[0] * std::cos(v[1]) - (2.7 + 3.08 * c * c) * y[0] * y[0] - weight * std::sin(y[1])) / mass;
      out[1] = (v[0] * std::sin(v[1]) + 68.6 * c * y[0] * y[0] - weight * std::cos(y[1])) / (mass * y[0]);
      out[2] = y[0] * std::sin(y[1]);
    };
    scots::runge_kutta_fixed4(f, x, u, 3, 0.25, 5);
  }
  void grow(State& r, const Input& u) const {
    auto f = [](State& out, const State& y, const Input& v) {
      const double c = 1.25 + 4.2 * v[1];
      out[0] = -0.00191867 * (2.7 + 3.08 * c * c) * y[0] + 9.81 * y[1] + 0.108;
      out[1] = (0.002933 + 0.004802 * v[1]) * y[0] + 0.003623 * y[1] + 0.002;
      out[2] = 0.07483 * y[0] + 83.22 * y[1];
    };
    scots::runge_kutta_fixed4(f, r, u, 3, 0.25, 5);
  }
  // As published, with `- error` in the last term where a bound on the vertical speed over the cell has `+ error`.
  bool wanted(const State& x) const {
    const double fastest = x[0] + eta[0] / 2 + error[0];
    return inside(x, {{63, -3 * degree, 0}}, {{75, 0, 2.5}}) &&
           -0.91 <= x[0] * std::sin(x[1]) - eta[0] / 2 - error[0] - fastest * (eta[1] / 2 - error[1]);
  }
};

struct Pendulum : Problem<2, 1> {
  enum { reach = false };
  State gap;
  explicit Pendulum(char** given) {
    low = {{0, -0.25}}, high = {{0.2, 0.25}}, error = {{0, 0}}, least = {{-1}}, most = {{1}};
    distances(given);
    gap = {{std::atof(given[3]), std::atof(given[4])}};
  }
  void flow(State& x, const Input& u) const {
    const double pull = -14.715 * std::sin(x[0]) + 3 * u[0];
    x[0] += 0.005 * x[1];
    x[1] += 0.005 * pull;
  }
  void grow(State& r, const Input&) const {
    const double pull = 14.715 * r[0];
    r[0] += 0.005 * r[1] + gap[0];
    r[1] += 0.005 * pull + gap[1];
  }
  bool wanted(const State& x) const { return inside(x, low, high); }
};

template <bool reach>
struct Game {
  template <class Wanted, class Avoided>
  static scots::WinningDomain solve(const scots::TransitionFunction& f, Wanted& wanted, Avoided& avoided) {
    return scots::solve_reachability_game(f, wanted, avoided);
  }
};

template <>
struct Game<false> {
  template <class Wanted, class Avoided>
  static scots::WinningDomain solve(const scots::TransitionFunction& f, Wanted& wanted, Avoided&) {
    return scots::solve_invariance_game(f, wanted);
  }
};

template <class P>
void run(const P& p, const char* file) {
  using State = typename P::State;
  using Input = typename P::Input;
  const double start = seconds();
  const scots::UniformGrid cells(P::states, p.low, p.high, p.eta), values(P::inputs, p.least, p.most, p.step);
  auto at = [&cells](Index i) {
    State x;
    cells.itox(i, x);
    return x;
  };
  auto flow = [&p](State& x, const Input& u) { p.flow(x, u); };
  auto grow = [&p](State& r, const State&, const Input& u) { p.grow(r, u); };
  auto avoided = [&](const Index& i) { return p.avoided(at(i)); };
  auto wanted = [&](const Index& i) { return p.wanted(at(i)); };

  scots::TransitionFunction transitions;
  scots::Abstraction<State, Input> abstraction(cells, values);
  abstraction.verbose_off();
  if (p.measured) abstraction.set_measurement_error_bound(p.error);
  abstraction.compute_gb(transitions, flow, grow, avoided);
  const double middle = seconds();
  const scots::WinningDomain won = Game<P::reach>::solve(transitions, wanted, avoided);
  const double end = seconds();
  const long most = memory();

  std::vector<char> bytes(cells.size());
  std::size_t number = 0;
  for (Index i = 0; i < cells.size(); i++) {
    number += won.is_winning(i);
    bytes[i] = won.is_winning(i) || (P::reach && wanted(i) && !avoided(i));
  }
  std::ofstream out(file, std::ios::binary);
  out.write(bytes.data(), bytes.size());
  if (!P::reach) {
    std::vector<char> valid(values.size());
    for (Index i = 0; i < cells.size(); i++) {
      valid.assign(values.size(), 0);
      if (won.is_winning(i))
        for (const Index j : won.get_inputs(i)) valid[j] = 1;
      out.write(valid.data(), valid.size());
    }
  }
  std::cout << cells.size() << " " << values.size() << " " << transitions.get_no_transitions() << " " << number << " "
            << middle - start << " " << end - middle << " " << most << std::endl;
}

}  // namespace

int main(int count, char** given) {
  const std::string name = count > 2 ? given[1] : "";
  if (name == "dcdc" && count == 6) return run(Dcdc(given + 3), given[2]), 0;
  if (name == "vehicle" && count == 8) return run(Vehicle(given + 3), given[2]), 0;
  if (name == "aircraft" && count == 8) return run(Aircraft(given + 3), given[2]), 0;
  if (name == "pendulum" && count == 8) return run(Pendulum(given + 3), given[2]), 0;
  std::cerr << "scots: PROBLEM FILE DISTANCE..." << std::endl;
  return 2;
}
