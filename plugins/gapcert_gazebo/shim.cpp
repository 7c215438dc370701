// The C interface to a robot in Gazebo's physics: rows of states go in and come back one period later.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "robot.hh"

namespace {

// ODE and Gazebo's logging keep process-wide state.
std::mutex everything;
thread_local std::string failure;

// A query must not depend on the one before: what the collision detector remembers (pairs, contacts, their order) goes with it.
void set_state(Robot &robot, const double *joints, const double *base) {
  auto &now = robot.now;
  if (robot.touches) now.world->SetCollisionDetector(robot.detector);
  for (std::size_t j = 0; j < now.joints.size(); ++j) {
    now.joints[j].joint->SetPosition(0, joints[2 * j]);
    now.joints[j].joint->SetVelocity(0, joints[2 * j + 1]);
  }
  if (!now.base) return;
  // The free joint's own coordinates, straight from the quaternion: a matrix in between would cost digits near a half turn.
  Eigen::Quaterniond q = Eigen::Quaterniond(base[3], base[4], base[5], base[6]).normalized();
  if (q.w() < 0) q.coeffs() *= -1;
  const double sine = q.vec().norm(), scale = sine > 0 ? 2 * std::atan2(sine, q.w()) / sine : 2;
  const Vector3d turn = scale * q.vec(), place(base[0], base[1], base[2]);
  const Vector3d spin = q.conjugate() * Vector3d(base[10], base[11], base[12]);
  const Vector3d speed = q.conjugate() * Vector3d(base[7], base[8], base[9]);
  for (int k = 0; k < 3; ++k) {
    now.base->SetPosition(k, turn[k]), now.base->SetPosition(k + 3, place[k]);
    now.base->SetVelocity(k, spin[k]), now.base->SetVelocity(k + 3, speed[k]);
  }
}

// A motor takes the joint's own command, so a force beside it acts on the two links.
void push(const Movable &m, double force) {
  const auto frame = m.joint->FrameDataRelativeToWorld();
  if (m.turns) {
    const Vector3d torque = force * (frame.pose.linear() * m.joint->CastToRevoluteJoint()->GetAxis());
    m.child->AddExternalTorque(ph::RelativeTorque3d(ph::FrameID::World(), torque));
    if (m.parent) m.parent->AddExternalTorque(ph::RelativeTorque3d(ph::FrameID::World(), -torque));
    return;
  }
  const Vector3d along = force * (frame.pose.linear() * m.joint->CastToPrismaticJoint()->GetAxis());
  const ph::RelativePosition3d at(ph::FrameID::World(), frame.pose.translation());
  m.child->AddExternalForce(ph::RelativeForce3d(ph::FrameID::World(), along), at);
  if (m.parent) m.parent->AddExternalForce(ph::RelativeForce3d(ph::FrameID::World(), -along), at);
}

void aim(Robot &robot, const double *command) {
  double heading = 0, turning = 0;
  if (robot.now.base) {
    double base[13];
    read_base(robot.now, base);
    const double w = base[3], x = base[4], y = base[5], z = base[6];
    heading = std::atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), turning = base[12];
  }
  for (std::size_t k = 0; k < robot.motors.size(); ++k) {
    auto &motor = robot.motors[k];
    motor.target = command[k] + motor.yaw * heading + motor.yaw_rate * turning;
  }
}

void drive(Robot &robot, const double *effort, std::vector<double> &total) {
  auto &joints = robot.now.joints;
  total.assign(effort, effort + joints.size());
  for (const auto &motor : robot.motors) {
    const auto &m = joints[motor.joint];
    if (m.rated) {
      m.joint->SetVelocityCommand(0, motor.target);
    } else {
      const double wanted = robot.gain * (motor.target - m.joint->GetVelocity(0));
      total[motor.joint] += std::min(std::max(wanted, -robot.limit), robot.limit);
    }
  }
  for (std::size_t j = 0; j < joints.size(); ++j) {
    if (!joints[j].rated) joints[j].joint->SetForce(0, total[j]);
    else if (total[j] != 0) push(joints[j], total[j]);
  }
}

void read_state(const Robot &robot, double *joints, double *base) {
  for (const auto &m : robot.now.joints) {
    *joints++ = m.joint->GetPosition(0);
    *joints++ = m.joint->GetVelocity(0);
  }
  if (robot.now.base) read_base(robot.now, base);
}

// Debian's DART asserts that numbers are finite and would end the process; no sum or product of these overflows.
bool sane(double number) { return std::abs(number) <= 1e12; }
bool sane(const double *numbers, std::size_t n) {
  return std::all_of(numbers, numbers + n, [](double number) { return sane(number); });
}

bool sane(const Robot &robot) {
  for (const auto &m : robot.now.joints)
    if (!sane(m.joint->GetVelocity(0))) return false;
  if (!robot.now.base) return true;
  const auto data = robot.now.root->FrameDataRelativeToWorld();
  return sane(data.linearVelocity.data(), 3) && sane(data.angularVelocity.data(), 3);
}

void advance(Robot &robot, std::int64_t n, int substeps, bool held, const double *joints, const double *effort, const double *base,
             const double *command, double *joints_after, double *base_after) {
  const std::size_t nj = robot.now.joints.size(), m = robot.motors.size();
  std::vector<double> total;
  for (std::int64_t row = 0; row < n; ++row) {
    const double *from = joints + 2 * nj * row, *push = effort + nj * (held ? row : row * substeps);
    bool fine = sane(from, 2 * nj) && sane(push, nj * (held ? 1 : substeps)) && sane(command + m * row, m);
    fine = fine && (!robot.now.base || sane(base + 13 * row, 13));
    if (fine) set_state(robot, from, base + 13 * row);
    for (int k = 0; fine && k < substeps; ++k) {
      if (m && k % robot.every == 0) aim(robot, command + m * row);
      drive(robot, push + (held ? 0 : nj * k), total);
      robot.now.step();
      fine = sane(robot);
    }
    if (!fine) refuse("row " + std::to_string(row) + " goes beyond 1e12, where Gazebo cannot follow; take shorter sub-steps");
    read_state(robot, joints_after + 2 * nj * row, base_after + 13 * row);
  }
}

template <typename Call>
int guarded(bool alone, Call call) {
  std::unique_lock<std::mutex> lock(everything, std::defer_lock);
  if (alone) lock.lock();
  try {
    call();
    return 0;
  } catch (const std::exception &error) {
    failure = error.what();
  } catch (...) {
    failure = "Gazebo threw something that is not an exception";
  }
  return 1;
}

}  // namespace

extern "C" {

const char *gapcert_failure() { return failure.c_str(); }

Robot *gapcert_open(const char *text, const char *model, const char *detector, const char *solver, std::int64_t nanoseconds) {
  std::unique_ptr<Robot> robot;
  guarded(true, [&] { robot = open(text, model, detector, solver, nanoseconds); });
  return robot.release();
}

void gapcert_close(Robot *robot) {
  guarded(true, [&] { delete robot; });
}

const char *gapcert_describe(const Robot *robot) { return robot->description.c_str(); }

int gapcert_set(Robot *robot, const double *values) {
  return guarded(true, [&] { set(*robot, values); });
}

// Without a gain (0) the joints follow Gazebo's own rate motor, within the limit.
int gapcert_drive(Robot *robot, int m, const std::int64_t *joints, const double *yaw, const double *yaw_rate, double gain,
                  double limit, int every) {
  return guarded(true, [&] {
    robot->gain = gain, robot->limit = limit, robot->every = every;
    for (int k = 0; k < m; ++k) robot->motors.push_back({static_cast<std::size_t>(joints[k]), yaw[k], yaw_rate[k], 0.0});
    arm(*robot);
  });
}

int gapcert_advance(Robot *robot, std::int64_t n, int substeps, int held, const double *joints, const double *effort,
                    const double *base, const double *command, double *joints_after, double *base_after) {
  return guarded(robot->touches,
                 [&] { advance(*robot, n, substeps, held, joints, effort, base, command, joints_after, base_after); });
}

// Place and rotation (w, x, y, z) of every link of the file, in its order, for n states: (n, links, 7).
int gapcert_poses(Robot *robot, std::int64_t n, const double *joints, const double *base, double *poses) {
  return guarded(robot->touches, [&] {
    const std::size_t nj = robot->now.joints.size();
    const auto model = robot->now.world->GetModel(robot->model->Name());
    for (std::int64_t row = 0; row < n; ++row) {
      const double *from = joints + 2 * nj * row, *floats = base + 13 * row;
      if (!sane(from, 2 * nj) || (robot->now.base && !sane(floats, 13))) refuse("a state goes beyond 1e12");
      set_state(*robot, from, floats);
      for (std::uint64_t k = 0; k < robot->model->LinkCount(); ++k) {
        const auto pose = model->GetLink(robot->model->LinkByIndex(k)->Name())->FrameDataRelativeToWorld().pose;
        const Eigen::Quaterniond q(pose.linear());
        for (int i = 0; i < 3; ++i) *poses++ = pose.translation()[i];
        for (const double part : {q.w(), q.x(), q.y(), q.z()}) *poses++ = part;
      }
    }
  });
}

// What a C++ program would write for joints that touch nothing: the measure of `gapcert_advance`.
void gapcert_bare(Robot *robot, std::int64_t n, int substeps, const double *joints, const double *effort, double *after) {
  auto &now = robot->now;
  for (std::int64_t row = 0; row < n; ++row) {
    for (const auto &m : now.joints) {
      m.joint->SetPosition(0, *joints++);
      m.joint->SetVelocity(0, *joints++);
    }
    for (int k = 0; k < substeps; ++k) {
      for (std::size_t j = 0; j < now.joints.size(); ++j) now.joints[j].joint->SetForce(0, effort[j]);
      now.world->Step(now.output, now.state, now.input);
    }
    effort += now.joints.size();
    for (const auto &m : now.joints) {
      *after++ = m.joint->GetPosition(0);
      *after++ = m.joint->GetVelocity(0);
    }
  }
}

}  // extern "C"
